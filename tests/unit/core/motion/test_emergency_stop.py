"""Tests of the emergency-stop input: its states, missing reports, and delays of this computer."""

from __future__ import annotations

from itertools import product
from typing import get_args

import pytest

from acsard.core.codes import Reason
from acsard.core.config.settings import EstopUse, SafetyConfig
from acsard.core.link.board_status import BoardStatus
from acsard.core.motion.emergency_stop import (
    PRESSED_REASON,
    SILENT_REASON,
    TRANSITIONS,
    EmergencyStop,
    Sign,
)
from acsard.core.values import EstopState
from tests.each import each

MS = 1_000_000

DRAWN = """
              ok        pressed   silence
    unknown   released  pressed   unknown
    released  released  pressed   silent
    pressed   released  pressed   pressed
    silent    released  pressed   silent
"""
"""The whole table drawn by hand."""


class Input:
    """An emergency-stop input with a simulated time. The first step is at 10 s."""

    def __init__(self, use: EstopUse = "auto") -> None:
        self.estop = EmergencyStop()
        self.safety = SafetyConfig(estop=use)
        self.now_ms = 10_000
        self.events: list[str] = []

    def step(self, *reports: bool | None, ms: int = 10) -> str:
        """Process these reports `ms` after the last step, and return the state."""
        self.now_ms += ms
        statuses = [(self.now_ms * MS, BoardStatus(estop=pressed)) for pressed in reports]
        self.events += [
            event.name
            for event in self.estop.process_reports(statuses, self.now_ms * MS, self.safety)
        ]
        return self.estop.state

    def quiet(self, ms: int) -> str:
        """Run steps without a report of the board for this time."""
        for _ in range(ms // 10):
            self.step()
        return self.estop.state


def test_the_table_is_the_one_drawn_by_hand() -> None:
    head, *rows = [line.split() for line in DRAWN.strip().splitlines()]
    drawn = {(row[0], sign): cell for row in rows for sign, cell in zip(head, row[1:], strict=True)}
    assert {state or "unknown" for state in get_args(EstopState)} == {row[0] for row in rows}
    assert set(get_args(Sign)) == set(head)
    for state, sign in product(get_args(EstopState), get_args(Sign)):
        assert (TRANSITIONS.get((state, sign), state) or "unknown") == drawn[
            state or "unknown", sign
        ]


def code(why: Reason | None) -> str:
    return "" if why is None else why.code


def test_an_input_that_is_never_reported_is_never_pressed() -> None:
    pin = Input()
    assert pin.quiet(2000) == pin.step(None) == ""
    assert (pin.estop.why(pin.safety), pin.events) == (None, [])


def test_a_press_counts_immediately_until_the_release() -> None:
    pin = Input()
    pin.step(False)
    assert pin.step(True) == "pressed"
    assert pin.estop.pressed_now == pin.estop.why(pin.safety) == PRESSED_REASON
    assert pin.step(True) == "pressed"
    assert (code(pin.estop.pressed_now), code(pin.estop.why(pin.safety))) == ("", "emergency_stop")
    assert pin.step(False) == "released"
    assert (code(pin.estop.why(pin.safety)), pin.estop.pressed) == ("", (False,))
    assert pin.events == ["emergency_stop_released", "emergency_stop", "emergency_stop_released"]


def test_a_press_and_its_release_in_one_read_still_count() -> None:
    pin = Input()
    pin.step(False)
    assert pin.step(True, False) == "released"
    assert (pin.estop.pressed_now, pin.estop.why(pin.safety)) == (PRESSED_REASON, None)


def test_the_first_report_may_be_a_press() -> None:
    pin = Input()
    assert pin.step(True) == "pressed"
    assert pin.estop.pressed_now == PRESSED_REASON


@each("before", [True, False])
def test_a_new_board_must_report_a_required_input_itself(before: bool) -> None:
    pin = Input("required")
    pin.step(before)
    pin.estop.reopen()
    assert pin.estop.missing(pin.safety)
    assert pin.step() == ("pressed" if before else "released")
    pin.step(False)
    assert not pin.estop.missing(pin.safety)


def test_the_input_is_forgotten_unless_the_new_board_reports_it() -> None:
    pin = Input()
    pin.step(True)
    pin.estop.reopen()
    pin.step(True)
    pin.estop.forget()
    assert pin.step() == "pressed"
    pin.estop.reopen()
    pin.estop.forget()
    assert pin.quiet(2000) == ""
    assert (pin.estop.pressed, pin.events) == (None, ["emergency_stop"])


def test_half_a_second_without_the_input_counts_as_pressed() -> None:
    pin = Input()
    pin.step(False)
    assert pin.quiet(500) == "released"
    assert pin.step(None) == "silent"
    assert pin.estop.pressed_now == pin.estop.why(pin.safety) == SILENT_REASON
    assert pin.quiet(1000) == "silent"
    assert pin.estop.pressed_now is None
    assert pin.step(True) == "pressed"
    assert pin.estop.pressed_now == PRESSED_REASON
    assert pin.quiet(1000) == "pressed"
    assert pin.step(False) == "released"


def test_lines_without_the_field_do_not_count_as_reports_of_it() -> None:
    pin = Input()
    pin.step(False)
    for _ in range(6):
        state = pin.step(None, ms=100)
    assert state == "silent"


def test_a_late_computer_first_reads_the_lines_that_waited() -> None:
    pin = Input()
    pin.step(False)
    assert pin.step(ms=3000) == "released"
    assert pin.step(False) == "released"
    # Without a line within 0.1 s after the stall the silence counts.
    assert pin.step(ms=3000) == "released"
    assert pin.quiet(100) == "released"
    assert pin.step() == "silent"


def test_a_computer_that_is_always_late_is_excused_once() -> None:
    pin = Input()
    pin.step(False)
    states = [pin.step(ms=200) for _ in range(5)]
    assert states == ["released", "released", "released", "silent", "silent"]


@each("state", [True, False])
def test_a_robot_without_the_input_ignores_reports(state: bool) -> None:
    pin = Input("off")
    assert pin.step(state) == pin.quiet(1000) == ""
    assert (pin.estop.pressed_now, pin.estop.missing(pin.safety), pin.events) == (None, False, [])


@pytest.mark.parametrize("use", ["auto", "required"])
def test_a_required_input_is_missing_until_the_first_report(use: EstopUse) -> None:
    pin = Input(use)
    assert pin.estop.missing(pin.safety) == (use == "required")
    pin.step(None)
    assert pin.estop.missing(pin.safety) == (use == "required")
    pin.step(True)
    assert not pin.estop.missing(pin.safety)
