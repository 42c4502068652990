"""A computer that runs late blames no part of the board that works."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from acsard.checkup import dialect, line_loss, procedure, reply_times
from acsard.checkup.board import Board
from acsard.checkup.findings import Finding
from acsard.checkup.lateness import (
    MAX_LATENESS_S,
    MAX_PAUSE_S,
    is_doubtful,
)
from acsard.checkup.outcomes import Outcome, TimingFinding, find
from acsard.core.simulator import protocol
from tests.each import each
from tests.unit.checkup_robots import (
    MS,
    Busy,
    Checked,
    Nobody,
    Robot,
    Starved,
    check,
)


def names(checked: Checked) -> set[str]:
    """Return the names of the findings that were not judged."""
    return {f.name for f in checked.findings if f.figure == "not judged"}


@pytest.mark.variations(10)
@pytest.mark.parametrize(
    ("computer", "fault", "late_s", "every"),
    [
        (Busy, "no_sample", 0.04, 2), (Busy, "plain_only", 0.15, 5),
        (Starved, "no_sample", 0.4, 40), (Busy, "free_running", 0.06, 3),
        (Busy, "no_sample", 0.4, 11), (Starved, "free_running", 0.15, 9),
        (Starved, "plain_only", 0.06, 3), (Starved, "plain_only", 0.4, 11),
        (Busy, "no_sample", 0.03, 1), (Starved, "no_sample", 0.15, 9),
    ],
)  # fmt: skip
def test_on_a_late_computer_no_board_is_blamed_and_no_other_setting_is_proposed(
    computer: type[Busy], fault: str, late_s: float, every: int
) -> None:
    period = 0.1 if fault == "free_running" else 0.0
    robot = computer(fault, late_s=late_s, every=every, reply_period=period, link_check="on")
    checked = Checked(robot)
    assert checked.failed == []
    assert set(checked.named("WARN")) <= names(checked) | {"reply form"}
    assert set(checked.changes) <= {"mcu.link_check", "mcu.encoder_counts"}
    for finding in checked.findings:
        if finding.figure == "not judged":
            late = f"this computer ran the check up to {1000 * late_s:.0f} ms too late"
            assert finding.text == f"{late}, so the check does not judge this step"
            assert "real-time priority" in finding.mend
    assert not checked.left_turning


@pytest.mark.slow
def test_a_step_that_a_late_moment_spoilt_is_repeated() -> None:
    for computer in (Busy, Starved):
        quiet = check("no_sample")
        checked = Checked(computer("no_sample", late_s=0.45, every=9, until_s=2.5))
        assert names(checked) == set()
        assert [f.verdict for f in checked.findings] == [f.verdict for f in quiet.findings]


def test_a_late_step_is_repeated_twice_and_all_of_them_eight_times() -> None:
    parts = [""]

    class Counts(Nobody):
        def doing(self, text: str) -> None:
            parts.append(text)

    robot, findings = Busy("plain_only", late_s=0.15, every=5), list[Finding]()
    with robot.faulty():
        procedure.run(robot, Counts(), robot.config, findings.append, fast=True)
    late = [finding.text for finding in findings if finding.figure == "not judged"]
    assert late
    assert all("ran the check up to 150 ms too late" in text for text in late)
    series = "".join("r" if "runs again" in part else " " for part in parts).split()
    assert max(series) == "r" * procedure.LATE_AGAIN
    assert len("".join(series)) == procedure.LATE_MOST


@each(
    "step",
    [dialect.trip, line_loss.finding, reply_times.finding, partial(dialect.comma, kind="late")],
)
def test_what_follows_from_a_step_that_was_late_is_not_judged(
    step: Callable[[Board], Finding | None],
) -> None:
    with Robot("plain_only").board() as board:
        assert not board.paced
        board.lateness.record(0.2, board.now_s)
        found = step(board)
    assert found is not None
    assert (found.figure, found.keys) == ("not judged", {})
    assert "up to 200 ms too late" in found.text


@pytest.mark.variations(5)
@pytest.mark.parametrize(
    ("fault", "name"),
    [
        ("reversed_encoder=b", "motor b (front left)"),
        ("swapped_motors=a:b", "motor a (front right)"),
        ("comma_latched", "trailing comma"),
        ("wrong_baud=57600", "baud rate"),
        ("no_watchdog", "watchdog"),
    ],
)
def test_a_fault_that_lateness_cannot_cause_is_reported(fault: str, name: str) -> None:
    checked = Checked(Busy(fault, late_s=0.03, every=3))
    assert checked[name].verdict == "FAIL"


def test_no_motor_is_turned_again_after_a_silence() -> None:
    """The check sends no further speed, even if this computer was late."""

    class Sags(Busy):
        silences = 0
        silent_ns = 0

        def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
            chunks = super().listen(until_ns)
            if any(abs(speed) > 1.0 for speed in self.mcu.vehicle.speeds):
                self.silences += self.now_ns() > self.silent_ns
                self.silent_ns = self.now_ns() + 400 * MS
            return [] if self.now_ns() < self.silent_ns else chunks

    verdicts = []
    turned = []
    for late_s in (0.0, 0.03):
        robot = Sags("plain_only", late_s=late_s, every=5)
        checked = Checked(robot)
        turned.append(robot.silences)
        verdicts.append(checked["link"].verdict)
        assert "watchdog" not in [finding.name for finding in checked.findings]
    assert turned[0] == turned[1]
    assert verdicts == ["FAIL", "WARN"]


def test_a_later_step_reports_a_fault_that_an_earlier_step_could_not_judge() -> None:
    class Refuses(Busy):
        """A robot that ignores lines without a comma, on a computer that is late in one step."""

        looked = False

        def wakes_late(self) -> bool:
            return self.looked and super().wakes_late()

    def obeys(line: bytes) -> protocol.BoardCommand | None:
        command = None if b"#" in line else protocol.reference(line, "abcd")
        if command and not line.endswith(b",\r\n"):
            if robot.looked:
                return None
            if not command.values[3]:
                command.values.pop(3)
        return command

    class Sees(Nobody):
        def doing(self, text: str) -> None:
            if "runs again" not in text:
                robot.looked = text.startswith("testing whether lines")

    robot = Refuses("plain_only", late_s=0.05, every=3)
    vars(robot.mcu)["understand"] = obeys
    findings: list[Finding] = []
    with robot.faulty():
        procedure.run(robot, Sees(), robot.config, findings.append, fast=True)
    matches = [finding for finding in findings if finding.name == "trailing comma"]
    assert [finding.figure for finding in matches] == ["not judged", "needed"]
    assert matches[1].keys == {"mcu.trailing_comma": True}


@each(
    ("outcome", "late_s", "doubted"),
    [
        ("watchdog: late", MAX_LATENESS_S, True), ("watchdog: late", 0.9 * MAX_LATENESS_S, False),
        ("watchdog: right", MAX_LATENESS_S, False), ("watchdog: right", MAX_PAUSE_S, True),
        ("watchdog: none", 10.0, False), ("reply rate: slow", MAX_LATENESS_S, True),
        ("lost lines: none", 10.0, False), ("motor: reversed, not seen", 10.0, False),
        ("motor: size", MAX_LATENESS_S, False), ("motor: size", 0.5, True),
    ],
)  # fmt: skip
def test_only_outcomes_that_a_late_computer_can_cause_are_doubted(
    outcome: Outcome, late_s: float, doubted: bool
) -> None:
    fields: dict[str, Any] = dict.fromkeys(
        ("figure", "seconds", "rate", "way", "gap", "quiet", "period", "lines", "here"), 1.0
    )
    fields |= {"error": 1.0, "tolerance": 0.25, "speed": 3.0}
    fields["margin_s"] = 0.5 if outcome == "motor: size" else 0.0
    result = find(outcome, **fields)
    assert (isinstance(result, TimingFinding) and is_doubtful(result, late_s)) is doubted
