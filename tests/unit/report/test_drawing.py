"""Tests of the words and numbers that the plotting library receives."""

from __future__ import annotations

import math
from itertools import combinations

from acsard.report.drawing import COMMANDERS, commander, label, numbers
from tests.unit.report.seen import column


def test_what_strangers_wrote_is_no_markup_and_fits() -> None:
    assert label("</script><b>x</b>\n&amp;") == "&lt;/script&gt;&lt;b&gt;x&lt;/b&gt; &amp;amp;"
    lines = label("a word and another " * 9 + "x" * 100).split("<br>")
    assert max(map(len, lines)) <= 42


def test_what_is_no_number_stays_none() -> None:
    assert math.isnan(column(numbers([1.0, math.nan]))[1])


def test_eight_who_drive_have_colours_that_nobody_takes_for_each_other() -> None:
    assert len(COMMANDERS) == 8
    rgb = [bytes.fromhex(commander(n)[0].removeprefix("#")) for n in range(8)]
    assert min(math.dist(one, other) for one, other in combinations(rgb, 2)) > 60


def test_whoever_comes_after_them_has_a_pattern() -> None:
    looks = [commander(n) for n in range(40)]
    assert len(set(looks)) == 40
    assert [pattern for _, pattern in looks[:8]] == [""] * 8
    assert all(pattern for _, pattern in looks[8:])
