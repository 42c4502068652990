"""Tests of the texts, numbers and lines that plotly receives."""

from __future__ import annotations

import math
from itertools import combinations

import pytest

from acsard.report.figures import path_figure
from acsard.report.plot_elements import SOURCE_COLOURS, label, numbers, source_style
from tests.unit.report.driven import drive_of_two
from tests.unit.report.seen import column, trace


def test_a_label_contains_no_markup_and_fits_on_a_phone() -> None:
    assert label("</script><b>x</b>\n&amp;") == "&lt;/script&gt;&lt;b&gt;x&lt;/b&gt; &amp;amp;"
    lines = label("a word and another " * 9 + "x" * 100).split("<br>")
    assert max(map(len, lines)) <= 42


def test_nan_stays_nan() -> None:
    assert math.isnan(column(numbers([1.0, math.nan]))[1])


def test_the_colours_of_eight_sources_are_easy_to_distinguish() -> None:
    assert len(SOURCE_COLOURS) == 8
    rgb = [bytes.fromhex(source_style(n)[0].removeprefix("#")) for n in range(8)]
    assert min(math.dist(colour, other) for colour, other in combinations(rgb, 2)) > 60


def test_further_sources_have_a_pattern() -> None:
    looks = [source_style(n) for n in range(40)]
    assert len(set(looks)) == 40
    assert [pattern for _, pattern in looks[:8]] == [""] * 8
    assert all(pattern for _, pattern in looks[8:])


def test_the_path_is_in_metres_with_equal_axes() -> None:
    report, _ = drive_of_two()
    drawn, places = path_figure(report), report.path.places()
    assert drawn.layout["yaxis"]["scaleanchor"] == "x"
    assert drawn.layout["yaxis"]["scaleratio"] == 1
    assert column(trace(drawn, "path")["x"]) == [place.x for place in places]
    assert column(trace(drawn, "end")["y"]) == [places[-1].y]
    assert len(column(trace(drawn, "stop")["x"])) == 1


def test_arrows_show_the_heading() -> None:
    report, _ = drive_of_two()
    heading = trace(path_figure(report), "heading")
    by_place = {(place.x, place.y): place.yaw for place in report.path.places()}
    places = zip(column(heading["x"]), column(heading["y"]), strict=True)
    yaws = [math.radians(90 - angle) for angle in heading["marker"]["angle"]]
    assert len(yaws) >= 8
    assert yaws == pytest.approx([by_place[place] for place in places], abs=1e-3)
