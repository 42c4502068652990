"""Tests of the lines that keyboard driving prints, and of the table of robots on a terminal."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
from msgspec.structs import replace
from rich.console import Console

from acsard.core.messages.schema import RobotState
from acsard.top import terminal
from acsard.top.drive_screen import HELP, Teleop
from acsard.top.fleet_table import Roster
from acsard.top.keyboard import KeyboardDrive
from acsard.top.terminal import NO_END, Page, ReportThrottle, print_last_report
from tests.unit.top.screens import STATE
from tests.unit.top.test_drive_screen import SEEN
from tests.unit.top.test_fleet_table import ROW


def printed_states(states: list[tuple[float, RobotState]]) -> list[RobotState]:
    """Return the states that are printed when these states arrive at these times, s."""
    throttle = ReportThrottle()
    return [
        state for now, state in states if throttle.should_print(replace(SEEN, state=state), now)
    ]


def test_a_robot_that_moves_is_a_line_a_second_and_one_at_rest_one_in_ten() -> None:
    moving = [(n / 20, replace(STATE, x=n / 40, linear=0.5)) for n in range(200)]
    assert len(printed_states(moving)) == 10
    sliding = [(n / 20, replace(STATE, linear=0.0, angular=0.0)) for n in range(200)]
    assert len(printed_states(sliding)) == 10  # its wheels turn
    resting = [(now, replace(state, wheels=[0.0] * 4)) for now, state in sliding]
    assert len(printed_states(resting)) == 1


def test_another_reason_is_reported_immediately_up_to_two_lines_a_second() -> None:
    stopped = replace(STATE, mode="stopped", reason="stopped by request")
    states = printed_states([(0.0, STATE), (0.5, stopped), (0.6, STATE), (1.0, STATE)])
    assert [state.mode for state in states] == ["driving", "stopped", "driving"]
    flickering = [(n / 20, replace(STATE, reason=f"because {n}")) for n in range(200)]
    assert len(printed_states(flickering)) <= 20


def test_the_help_is_repeated_before_reports_scroll_it_off_the_terminal() -> None:
    page, lines = Page(), list[str]()
    for number in range(100):
        lines += page.with_help([f"news {number}", *["more of it"] * (number % 4)], 24)
        # The last line of a terminal stays empty, because the cursor is there.
        assert list(HELP) == [line for line in lines[-23:] if line in HELP]
    assert lines.count(HELP[0]) < 30
    assert lines[-4:-3] == ["news 99"]


def test_output_to_a_file_has_the_help_once() -> None:
    page = Page()
    assert page.with_help(["news"], NO_END) == [*HELP, "news"]
    assert page.with_help(["news"] * 1000, NO_END) == ["news"] * 1000


class Ended:
    """A drive that has ended.

    Each `take` shows the robot's next state, and at the end the last one.
    """

    def __init__(self, *states: RobotState) -> None:
        self.states = list(states)

    def take(self) -> None:
        if len(self.states) > 1:
            self.states.pop(0)

    def screen_data(self) -> Teleop:
        return replace(SEEN, state=self.states[0], age=0.0)


def test_the_last_report_waits_until_the_robot_no_longer_follows_the_drive(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("os.isatty", lambda _: True)
    moving = replace(STATE, source="teleop", reason="commanded by teleop")
    still = replace(moving, linear=0.0, angular=0.0, wheels=[0.0] * 4)
    ready = replace(still, mode="ready", reason="waiting for a command", source="")
    print_last_report(cast(KeyboardDrive, Ended(moving, moving, still, still, ready)))
    assert (
        "drive ended: the robot stands still; ready: waiting for a command"
        in capsys.readouterr().out
    )
    other = replace(still, reason="commanded by nav", source="nav")
    print_last_report(cast(KeyboardDrive, Ended(still, still, other, ready)))
    assert (
        "drive ended: the robot stands still; driving: commanded by nav" in capsys.readouterr().out
    )


@pytest.mark.parametrize("height", [1, 2, 3, 24])
def test_a_terminal_of_any_height_shows_the_heading_of_the_table_of_robots(
    height: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def watch(draw: Any, suspend: list[bool]) -> bool:
        Console(width=80).print(draw(80, height))
        return False

    monkeypatch.setattr(terminal, "_watch", watch)
    monkeypatch.setattr(terminal, "_run_suspendable", lambda shows: shows([]))
    fleet = SimpleNamespace(rows=lambda: [ROW], left_out_text="", presence_text="1 robot")
    terminal.roster(cast(Roster, fleet))
    head, *others = capsys.readouterr().out.splitlines()
    assert head.startswith("ROBOT")
    assert others[-1] == "q quits   1 robot"
    assert any("robot1" in line for line in others) == (height == 24)
