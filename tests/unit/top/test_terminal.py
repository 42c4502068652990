"""Tests of the last report of keyboard driving, and of the table of robots on a terminal."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
from msgspec.structs import replace
from rich.console import Console

from acsard.core.messages.schema import RobotState
from acsard.top import terminal
from acsard.top.drive_screen import Teleop
from acsard.top.fleet_table import Roster
from acsard.top.keyboard import KeyboardDrive
from acsard.top.terminal import print_last_report
from tests.unit.top.screens import STATE
from tests.unit.top.test_drive_screen import SEEN
from tests.unit.top.test_fleet_table import ROW


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
    head, *others = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert head.startswith("ROBOT")
    assert others[-1] == "q quits   1 robot"
    assert any("robot1" in line for line in others)
