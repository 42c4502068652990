"""Tests of the plot of the path: metres, equal axes, headings, and the place of each event."""

from __future__ import annotations

import math

import pytest

from acsard.report.path import path
from tests.unit.report.driven import drive_of_two
from tests.unit.report.seen import column, trace


def test_the_path_is_in_metres_with_equal_axes() -> None:
    course, _ = drive_of_two()
    drawn, places = path(course), course.path.places()
    assert drawn.layout["yaxis"]["scaleanchor"] == "x"
    assert drawn.layout["yaxis"]["scaleratio"] == 1
    assert column(trace(drawn, "path")["x"]) == [place.x for place in places]
    assert column(trace(drawn, "end")["y"]) == [places[-1].y]
    assert len(column(trace(drawn, "stop")["x"])) == 1


def test_arrows_show_the_heading() -> None:
    course, _ = drive_of_two()
    heading = trace(path(course), "heading")
    by_place = {(place.x, place.y): place.yaw for place in course.path.places()}
    places = zip(column(heading["x"]), column(heading["y"]), strict=True)
    told = [math.radians(90 - angle) for angle in heading["marker"]["angle"]]
    assert len(told) >= 8
    assert told == pytest.approx([by_place[place] for place in places], abs=1e-3)
