"""Words and numbers as the library gets them."""

from __future__ import annotations

import math

from acsard.report.drawing import label, numbers
from tests.unit.report.seen import column


def test_what_strangers_wrote_is_no_markup_and_fits() -> None:
    assert label("</script><b>x</b>\n&amp;") == "&lt;/script&gt;&lt;b&gt;x&lt;/b&gt; &amp;amp;"
    lines = label("a word and another " * 9 + "x" * 100).split("<br>")
    assert max(map(len, lines)) <= 42


def test_what_is_no_number_stays_none() -> None:
    assert math.isnan(column(numbers([1.0, math.nan]))[1])
