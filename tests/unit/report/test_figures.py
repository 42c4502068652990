"""The pictures: the library takes them, and their numbers are those of the course."""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Iterable
from typing import Any

import plotly.graph_objects as library
import pytest

from acsard.report.figures import Figure, Pictures, label, numbers
from tests.scenarios.world import START
from tests.unit.report.driven import course_of, drive_of_two

OFFSET_S = 3600.0


@pytest.fixture(scope="module")
def figures() -> dict[str, Figure]:
    course, _ = drive_of_two()
    return {figure.name: figure for figure in Pictures(course, OFFSET_S).all()}


def column(packed: dict[str, str]) -> list[float]:
    data = binascii.a2b_base64(packed["bdata"])
    return list(struct.unpack(f"<{len(data) // 8}d", data))


def known(values: Iterable[float]) -> list[float | None]:
    """With what compares as equal in place of NaN."""
    return [None if math.isnan(value) else value for value in values]


def trace(figure: Figure, name: str, axis: str = "y") -> dict[str, Any]:
    (found,) = [t for t in figure.data if t["name"] == name and t.get("yaxis", "y") == axis]
    return found


def test_the_library_knows_every_word_of_them(figures: dict[str, Figure]) -> None:
    for figure in figures.values():
        made = library.Figure(data=figure.data, layout=figure.layout)
        assert len(made.data) == len(figure.data)


def test_the_path_is_in_metres_with_equal_axes(figures: dict[str, Figure]) -> None:
    course, _ = drive_of_two()
    path, places = figures["path"], course.path.places()
    assert path.layout["yaxis"]["scaleanchor"] == "x"
    assert path.layout["yaxis"]["scaleratio"] == 1
    assert column(trace(path, "path")["x"]) == [place.x for place in places]
    assert column(trace(path, "end")["y"]) == [places[-1].y]
    assert len(column(trace(path, "stop")["x"])) == 1


def test_arrows_show_the_heading(figures: dict[str, Figure]) -> None:
    course, _ = drive_of_two()
    heading = trace(figures["path"], "heading")
    by_place = {(place.x, place.y): place.yaw for place in course.path.places()}
    places = zip(column(heading["x"]), column(heading["y"]), strict=True)
    told = [math.radians(90 - angle) for angle in heading["marker"]["angle"]]
    assert len(told) >= 8
    assert told == pytest.approx([by_place[place] for place in places], abs=1e-3)


def test_a_speed_is_at_the_time_of_the_clock_on_the_wall(figures: dict[str, Figure]) -> None:
    course, _ = drive_of_two()
    points, drawn = course.linear["measured"].points(), trace(figures["speeds"], "measured")
    assert known(column(drawn["y"])) == known(point.value for point in points)
    zero_ms = 1000 * (START.wall_ns / 1e9 + OFFSET_S)
    times = [(ms - zero_ms) / 1000 for ms in column(drawn["x"])]
    assert times == pytest.approx([point.t for point in points], abs=0.02)


def test_each_wheel_has_a_picture_of_its_own(figures: dict[str, Figure]) -> None:
    course, _ = drive_of_two()
    for n, curve in enumerate(course.turned):
        drawn = trace(figures["wheels"], "measured", f"y{n + 1}" if n else "y")
        assert known(column(drawn["y"])) == known(point.value for point in curve.points())


def test_bands_say_why_whoever_wrote_it(figures: dict[str, Figure]) -> None:
    waits = trace(figures["who"], "waits")
    words = [text.replace("<br>", " ") for text in waits["hovertext"]]
    assert "<b>waits</b> teleop has the higher priority: until it is silent" in words
    assert max(column(waits["x"])) > 1500  # ms
    rows = [note["text"] for note in figures["who"].layout["annotations"]]
    assert rows == ["mode", "link", "teleop", "nav", "others"]
    assert "Silent all the time: app, ros2_control." in figures["who"].caption


def test_what_strangers_wrote_is_no_markup_and_fits() -> None:
    assert label("</script><b>x</b>\n&amp;") == "&lt;/script&gt;&lt;b&gt;x&lt;/b&gt; &amp;amp;"
    lines = label("a word and another " * 9 + "x" * 100).split("<br>")
    assert max(map(len, lines)) <= 42


def test_what_is_no_number_stays_none() -> None:
    assert math.isnan(column(numbers([1.0, math.nan]))[1])


def test_a_robot_that_was_never_heard_is_drawn_all_the_same() -> None:
    def mute(world: Any) -> None:
        world.port.unplug()
        world.run(1.0)

    course, _ = course_of(mute)
    for figure in Pictures(course, 0.0).all():
        library.Figure(data=figure.data, layout=figure.layout)
