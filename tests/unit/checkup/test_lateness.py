"""The check reports a finding as not judged when this computer ran late."""

from __future__ import annotations

from typing import Any

import pytest

from acsard.checkup.lateness import (
    MAX_LATENESS_S,
    MAX_PAUSE_S,
    MIN_DELAY_S,
    HostDelays,
    finding,
    is_doubtful,
    judged,
)
from acsard.checkup.motion import LINE_PERIOD_S
from acsard.checkup.outcomes import TimingFinding, find
from tests.each import each
from tests.unit.checkup.robots import Busy, Robot, Starved


def test_the_largest_lateness_since_a_time_is_reported() -> None:
    lateness = HostDelays()
    for late_s, now_s in ((0.3, 1.0), (0.02, 2.0), (0.05, 3.0), (MIN_DELAY_S / 2, 4.0)):
        lateness.record(late_s, now_s)
    assert [lateness.since(s) for s in (0.0, 1.0, 1.5, 3.0, 3.5)] == [0.3, 0.3, 0.05, 0.05, 0.0]


@each(
    ("outcome", "late_s", "doubted"),
    [
        ("watchdog: late", MAX_LATENESS_S, True),
        ("watchdog: late", 0.9 * MAX_LATENESS_S, False),
        ("watchdog: right", MAX_LATENESS_S, False),
        ("watchdog: right", MAX_PAUSE_S, True),
        ("watchdog: none", 10.0, False),
        ("reply rate: slow", MAX_LATENESS_S, True),
        ("lost lines: none", 10.0, False),
        ("motor: reversed, not seen", 10.0, False),
        ("motor: size", MAX_LATENESS_S, False),
        ("motor: size", 0.5, True),
    ],
)
def test_only_outcomes_that_a_late_computer_can_cause_are_doubted(
    outcome: str, late_s: float, doubted: bool
) -> None:
    fields: dict[str, Any] = dict.fromkeys(
        ("figure", "seconds", "rate", "way", "gap", "quiet", "period", "lines", "here"), 1.0
    )
    fields |= {"error": 1.0, "tolerance": 0.25, "speed": 3.0}
    fields["margin_s"] = 0.5 if outcome == "motor: size" else 0.0
    result = find(outcome, **fields)
    assert (isinstance(result, TimingFinding) and is_doubtful(result, late_s)) is doubted


def test_a_step_that_is_not_judged_is_a_warning_without_keys() -> None:
    result = finding("watchdog", 0.085)
    assert (result.name, result.verdict, result.keys) == ("watchdog", "WARN", {})
    text = "this computer ran the check up to 85 ms too late, so the check does not judge this step"
    assert result.text == text
    assert not judged(result)
    assert judged(find("baud rate: right", rate=9600))


def test_lateness_is_measured_for_every_duration_of_listening() -> None:
    for seconds in (LINE_PERIOD_S, 0.5):
        with Busy(late_s=0.08, every=7).board(rest=False) as board:
            for _ in range(7):
                board.listen(seconds)
            assert board.lateness.since(0.0) == pytest.approx(0.08)
    with Starved(late_s=0.08, every=7).board(rest=False) as board:
        board.listen(0.5)
        assert board.lateness.since(0.0) == pytest.approx(0.08)


def test_the_time_to_ask_a_person_is_not_lateness() -> None:
    robot = Robot()
    with robot.board() as board:
        board.drive((0.0, 0.0, 0.0, 3.0), 0.3)
        board.stop_motors()
        robot.listen(robot.now_ns() + 20_000_000_000)
        board.drive((0.0, 0.0, 0.0, 3.0), 0.3)
        assert board.lateness.since(0.0) == 0.0
