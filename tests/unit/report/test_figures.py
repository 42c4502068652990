"""The figures show the numbers of the report's data."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable
from typing import Any

import pytest

from acsard.core.config.parsing import parse
from acsard.core.config.settings import Config, McuConfig
from acsard.core.thinning import Point
from acsard.report.figures import Clip, TimeFigures, clipped
from acsard.report.plot_elements import Figure
from tests.scenarios.taped import Tape, happenings
from tests.scenarios.world import START, World
from tests.unit.report.driven import drive_of_two, report_from, report_of, two_drivers
from tests.unit.report.seen import column, trace

OFFSET_S = 3600.0


@pytest.fixture(scope="module")
def figures() -> dict[str, Figure]:
    report, _ = drive_of_two()
    return {figure.name: figure for figure in TimeFigures(report, OFFSET_S).all()}


def without_nan(values: Iterable[float]) -> list[float | None]:
    """Return the values with None in place of NaN, so that they compare as equal."""
    return [None if math.isnan(value) else value for value in values]


def all_that_happens(world: World) -> None:
    two_drivers(world)
    happenings(world, random.Random(1))


@pytest.mark.slow
def test_no_two_symbols_of_a_picture_look_alike() -> None:
    report, _ = report_of(all_that_happens)
    for figure in TimeFigures(report, OFFSET_S).all():
        signs = [(key.sign, key.colour) for key in figure.keys]
        assert len(signs) == len(set(signs)) > 0, figure.keys
    keys = {key.meaning for figure in TimeFigures(report, OFFSET_S).all() for key in figure.keys}
    assert keys >= {"stop", "link down", "driving, teleop drives"}


@pytest.mark.slow
def test_a_curve_under_another_curve_stays_visible(figures: dict[str, Figure]) -> None:
    for name, beneath in (("speeds", "limited"), ("wheels", "commanded"), ("link", "sent")):
        widths = {curve["name"]: curve["line"]["width"] for curve in figures[name].data}
        below = [curve["name"] for curve in figures[name].data].index(beneath)
        above = figures[name].data[below + 1]["name"]
        assert widths[beneath] > 2 * widths[above]


def test_speeds_are_drawn_at_local_times(figures: dict[str, Figure]) -> None:
    report, _ = drive_of_two()
    points, drawn = report.linear["measured"].points(), trace(figures["speeds"], "measured")
    assert without_nan(column(drawn["y"])) == without_nan(point.value for point in points)
    zero_ms = 1000 * (START.wall_ns / 1e9 + OFFSET_S)
    times = [(ms - zero_ms) / 1000 for ms in column(drawn["x"])]
    assert times == pytest.approx([point.t for point in points], abs=0.02)


def faster_than_any_robot(world: World) -> None:
    """Drive at 0.3 m/s, with one command of 99 m/s and -50 rad/s in between."""
    world.drive(0.3, seconds=1.0, source="nav")
    world.send(99.0, -50.0, "nav")
    world.run(0.05)
    world.drive(0.3, seconds=1.0, source="nav")


@pytest.mark.slow
def test_one_command_of_99_m_s_does_not_flatten_the_speeds() -> None:
    report, _ = report_of(faster_than_any_robot)
    figure = TimeFigures(report, OFFSET_S).speeds()
    for axis, wish in (("y", 99.0), ("y2", -50.0)):
        measured = max(abs(value) for value in column(trace(figure, "measured", axis)["y"]))
        commanded = trace(figure, "commanded", axis)
        assert max(abs(value) for value in column(commanded["y"])) < max(2.0 * measured, 0.5)
        assert wish in column(commanded["customdata"])
        mark = trace(figure, "commanded outside", axis)
        assert column(mark["customdata"]) == [wish]
        assert mark["marker"]["symbol"] == ["triangle-up" if wish > 0 else "triangle-down"]
    assert "the largest of these is 99 m/s and -50 rad/s." in figure.caption
    assert ("▲", "commanded outside of the picture") in [(k.sign, k.meaning) for k in figure.keys]


def test_commands_near_the_driven_speeds_are_drawn_as_they_are(figures: dict[str, Figure]) -> None:
    report, _ = drive_of_two()
    drawn = column(trace(figures["speeds"], "commanded")["y"])
    assert without_nan(drawn) == without_nan(
        point.value for point in report.linear["commanded"].points()
    )
    assert "triangle" not in figures["speeds"].caption
    assert [curve["name"] for curve in figures["speeds"].data].count("commanded outside") == 0


def test_a_curve_is_marked_each_time_it_leaves_the_scale_of_the_others() -> None:
    values = [0.0, 9.0, 12.0, 0.5, -7.0, math.nan, -6.0, 1.4]
    points = [Point(float(t), value) for t, value in enumerate(values)]
    drawn, clips = clipped(points, [[Point(0.0, 1.0), Point(1.0, math.nan)]], 0.1, 1.0)
    expected = [0.0, 1.5, 1.5, 0.5, -0.5, None, -0.5, 1.4]
    assert without_nan(point.value for point in drawn) == expected
    assert clips == [Clip(1.0, 1.5, 12.0), Clip(4.0, -0.5, -7.0), Clip(6.0, -0.5, -6.0)]


def test_each_wheel_has_a_picture_of_its_own(figures: dict[str, Figure]) -> None:
    report, _ = drive_of_two()
    for n, curve in enumerate(report.measured_wheels):
        drawn = trace(figures["wheels"], "measured", f"y{n + 1}" if n else "y")
        assert without_nan(column(drawn["y"])) == without_nan(
            point.value for point in curve.points()
        )


def test_bands_show_the_reason_on_hover(figures: dict[str, Figure]) -> None:
    waits = trace(figures["sources"], "waits")
    words = [text.replace("<br>", " ") for text in waits["hovertext"]]
    assert "<b>waits</b> teleop has priority: wait until it is silent" in words
    assert max(column(waits["x"])) > 1500  # in ms
    assert "for example, while a source with a higher priority sends" in figures["sources"].caption
    rows = [note["text"] for note in figures["sources"].layout["annotations"]]
    assert rows == ["mode", "link", "teleop", "nav", "others"]
    assert (
        "These sources were silent all the time: app, ros2_control, dock."
        in figures["sources"].caption
    )


def drivers(figure: Figure) -> dict[str, tuple[str, str]]:
    """Return the colour and pattern of each source that drove."""
    drives = [bar for bar in figure.data if bar["name"].endswith(" drives")]
    looks = {bar["name"].split()[0]: bar["marker"] for bar in drives}
    return {
        name: (look["color"], look.get("pattern", {}).get("shape", ""))
        for name, look in looks.items()
    }


def test_two_driving_sources_have_two_colours_in_the_legend(figures: dict[str, Figure]) -> None:
    figure = figures["sources"]
    looks = drivers(figure)
    assert set(looks) == {"teleop", "nav"}
    assert len(set(looks.values())) == 2
    keys = {label: key.colour for key in figure.keys for label in key.meaning.split(", ")}
    assert {name: keys[f"{name} drives"] for name in looks} == {n: c for n, (c, _) in looks.items()}


@pytest.mark.slow
def test_ten_driving_sources_have_different_styles() -> None:
    rows = [f'[[commands.sources]]\nname = "app{n}"\npriority = {n}\n' for n in range(10)]
    config, tape = parse("".join(rows).encode()), Tape()
    world = World(config, recorder=tape)
    for n in range(10):
        world.drive(0.3, seconds=0.1, source=f"app{n}")
        world.run(0.3)
    figure = TimeFigures(report_from(tape.steps(), config), OFFSET_S).sources()
    looks = drivers(figure)
    assert len(looks) == len(set(looks.values())) == 10
    assert [pattern != "" for _, pattern in looks.values()] == [False] * 8 + [True] * 2


def test_the_reports_of_a_board_with_its_own_clock_are_not_called_answers() -> None:
    def reporting(world: World) -> None:
        with world.mcu.free_running(0.1):
            world.run(0.5)

    def shown(mcu: McuConfig) -> tuple[set[str], str]:
        report, _ = report_of(reporting, config=Config(mcu=mcu))
        figure = TimeFigures(report, 0.0).serial()
        return {key.meaning for key in figure.keys}, figure.caption

    answering, _ = shown(McuConfig())
    assert answering == {"sent", "answered", "dropped", "no answer"}
    names, caption = shown(McuConfig(reply_period=0.1))
    assert names == {"sent", "received", "dropped"}
    assert "answer" not in caption


def test_a_robot_without_feedback_is_drawn() -> None:
    def mute(world: Any) -> None:
        world.port.unplug()
        world.run(1.0)

    report, _ = report_of(mute)
    assert len(TimeFigures(report, 0.0).all()) == 7
