"""Tests of the summary of a recording in words."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import BatteryConfig, Config, McuConfig, Source
from acsard.report.figures import path_figure
from acsard.report.report_text import Origin, Setting, differences, reasons, rows, summary
from tests.scenarios.world import World
from tests.unit.report.driven import drive_of_two, report_of


def test_the_summary_has_distance_speed_and_the_client_that_stopped_the_robot() -> None:
    report, _ = drive_of_two()
    text = summary(report)
    assert text.startswith(f"The robot drove {report.metres:.2f} m in ")
    assert f"at most {report.fastest.linear:.2f} m/s and {report.fastest.angular:.2f} rad/s" in text
    assert text.endswith("There were no faults, 1 stop (by unnamed (native)).")


def test_the_summary_of_a_standing_robot_says_that_it_did_not_drive() -> None:
    report, _ = report_of(lambda world: world.run(0.5))
    assert summary(report).startswith("The robot did not drive in the recorded 0.5 s.")


def test_a_fault_is_listed_with_its_time_and_its_text() -> None:
    def stuck(world: World) -> None:
        world.drive(0.5, seconds=0.5)
        with world.mcu.dead_motor(0):
            world.hold(0.5, 0.4, seconds=1.5)

    report, _ = report_of(stuck)
    assert "There was 1 fault" in summary(report)
    origin = Origin("a.mcap", "r2", "0.1.0", "3.11.0")
    table = dict(rows(report, origin, lambda s, day: f"<{s:.0f}{' day' if day else ''}>"))
    assert table["Faults"].startswith("1: <1800000")
    assert "front_right wheel" in table["Faults"]
    assert table["When"] == "<1800000000 day> to <1800000002 day>"
    assert table["Recorded by"] == "acsard 0.1.0, Python 3.11.0"


def test_a_pressed_emergency_stop_is_counted_and_listed_and_drawn_on_the_path() -> None:
    def pressed(world: World) -> None:
        with world.mcu.estop():
            world.drive(0.5, seconds=1.0)
            with world.mcu.estop_pressed(0.0, 0.0):
                world.run(0.5)
            world.run(0.5)

    report, _ = report_of(pressed)
    assert summary(report).endswith("There were no faults, no stops, 1 emergency stop.")
    origin = Origin("a.mcap", "r2", "0.1.0", "3.11.0")
    table = dict(rows(report, origin, lambda s, day: f"<{s:.0f}>"))
    assert table["Emergency stops"].startswith("1: <1800000001> emergency stop pressed at the")
    assert "emergency stop" in {key.meaning for key in path_figure(report).keys}


@pytest.mark.slow
def test_a_pressed_bumper_is_counted_and_listed_and_drawn_on_the_path() -> None:
    def pressed(world: World) -> None:
        with world.mcu.bumpers():
            world.drive(0.5, seconds=1.0)
            with world.mcu.bumper_pressed(2, 0.0, 0.0):
                world.run(0.5)
            world.run(0.5)

    report, _ = report_of(pressed)
    assert summary(report).endswith("There were no faults, no stops, 1 bumper hit.")
    origin = Origin("a.mcap", "r2", "0.1.0", "3.11.0")
    table = dict(rows(report, origin, lambda s, day: f"<{s:.0f}>"))
    assert table["Bumper hits"].startswith("1: <1800000001> bumper 2 pressed")
    assert "bumper pressed" in {key.meaning for key in path_figure(report).keys}


@pytest.mark.slow
def test_a_battery_stop_is_counted_and_listed_and_drawn_on_the_path() -> None:
    config = Config(battery=BatteryConfig(stop_below=21.0))

    def empty(world: World) -> None:
        with world.mcu.battery(0.0, 60.0):
            world.drive(0.5, seconds=5.0)

    report, _ = report_of(empty, config=config)
    assert summary(report).endswith("There were no faults, no stops, 1 battery stop.")
    origin = Origin("a.mcap", "r2", "0.1.0", "3.11.0")
    table = dict(rows(report, origin, lambda s, day: f"<{s:.0f}>"))
    assert table["Battery stops"].startswith("1: <1800000003> ")
    assert (
        "the mean of the last seconds is below battery.stop_below = 21 V" in table["Battery stops"]
    )
    assert "battery stop" in {key.meaning for key in path_figure(report).keys}


def test_a_host_stall_does_not_count_as_a_loss_of_the_link() -> None:
    def late(world: World) -> None:
        world.drive(0.5, seconds=0.5)
        with world.mcu.mute():
            world.stall(0.2)
            world.run(0.05)

    report, _ = report_of(late)
    assert summary(report).endswith("no stops, 1 stall of the robot's computer.")


def test_the_reports_of_a_board_with_its_own_clock_are_not_called_answers() -> None:
    def reporting(world: World) -> None:
        with world.mcu.free_running(0.1):
            world.run(0.5)

    def serial_line(mcu: McuConfig) -> str:
        report, _ = report_of(reporting, config=Config(mcu=mcu))
        origin = Origin("a.mcap", "r2", "0.1.0", "3.11.0")
        return dict(rows(report, origin, lambda s, day: f"<{s:.0f}>"))["Serial line"]

    assert " answers, 0 dropped" in serial_line(McuConfig())
    text = serial_line(McuConfig(reply_period=0.1))
    assert text.endswith(" reports received, 0 dropped")
    assert "answer" not in text


def test_only_settings_that_differ_from_the_default_are_listed() -> None:
    config = Config()
    assert differences(config) == []
    sources = (*config.commands.sources, Source("joe", 7))
    other = replace(
        config,
        limits=replace(config.limits, linear_speed=0.3),
        commands=replace(config.commands, sources=sources),
    )
    assert differences(other) == [
        Setting("limits.linear_speed", "0.3", "1.0"),
        Setting("commands.sources.joe.priority", "7", "-"),
        Setting("commands.sources.joe.timeout", "0.25", "-"),
    ]


def test_the_longest_reason_comes_first() -> None:
    report, _ = drive_of_two()
    first, *rest = reasons(report)
    assert first[:2] == ("nav", "waits")
    assert all(first[3] >= other[3] for other in rest)


def test_reasons_that_differ_in_a_number_count_as_one_with_the_longest_text() -> None:
    report, _ = report_of(lambda world: world.run(0.1))
    band = report.sources.bands["app"]
    for n, t in enumerate((1.0, 1.5, 3.5)):
        band.add(t, "waits", f"lines come 0.1{n} s apart")
    band.end(4.0)
    assert reasons(report) == [("app", "waits", "lines come 0.11 s apart", 3.0)]
