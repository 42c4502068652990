"""Tests of the whole check in virtual time: good robots pass, and the check names each fault."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import pytest

from acsard.checkup import procedure
from acsard.checkup.board import FINAL_ZEROS
from acsard.checkup.findings import SKIPPED_STEPS, Finding, WireLostError
from acsard.checkup.motion import SPEED
from acsard.core.config.settings import Config, McuConfig, SimConfig, WheelMap
from acsard.core.link.codec import Codec
from acsard.core.simulator import protocol
from acsard.core.values import NS_PER_S, WHEELS
from tests.unit.checkup.robots import (
    MS,
    Busy,
    Checked,
    Nobody,
    Person,
    Robot,
    Starved,
    check,
    configured,
)

MOTORS = "abcd"


def slow(value: object) -> object:
    return pytest.param(value, marks=pytest.mark.slow)


# robots without a fault

GOOD: dict[str, tuple[tuple[str, ...], dict[str, Any]]] = {
    "plain": (("plain_only",), {}),
    "checked": (("no_sample",), {"link_check": "on"}),
    "samples": ((), {"link_check": "on", "encoder_counts": 3200}),
    "old sketch": (("free_running", "plain_only"), {"reply_period": 0.1}),
    "comma sent": ((), {"trailing_comma": True}),
    "status lines": (("plain_only", "estop"), {}),
    "checked status lines": (("no_sample", "estop"), {"link_check": "on"}),
}


@pytest.mark.variations(3)
@pytest.mark.parametrize(("faults", "mcu"), GOOD.values(), ids=GOOD)
@pytest.mark.parametrize("person", [False, True])
def test_a_robot_without_faults_passes(
    faults: tuple[str, ...], mcu: dict[str, Any], person: bool
) -> None:
    checked = check(*faults, person=person, **mcu)
    assert checked.failed == []
    assert checked.named("WARN") == (["reply form"] if "free_running" in faults else [])
    assert not checked.left_turning
    new = {"mcu.link_check", "mcu.encoder_counts"} if not faults and len(mcu) == 1 else set()
    assert set(checked.changes) == new


@pytest.mark.variations(3)
@pytest.mark.parametrize("baud", [9600, 19200, 38400, 57600])
def test_a_slow_wire_passes(baud: int) -> None:
    config = configured(Config(), baud_rate=baud)
    assert check(config=config).failed == []


@pytest.mark.slow
@pytest.mark.parametrize("lag", [0.0, 0.2])
def test_quick_and_slow_motors_pass_and_their_watchdog_is_measured(lag: float) -> None:
    for faults in ((), ("plain_only",), ("free_running",)):
        checked = check(*faults, config=Config(sim=SimConfig(motor_time_constant=lag)))
        assert set(checked.failed) <= {"reply rate"}
        assert int(checked["watchdog"].figure.split()[0]) == pytest.approx(300, abs=60)


@pytest.mark.parametrize("per_turn", [16, slow(24), slow(48), slow(64)])
@pytest.mark.parametrize("fault", [(), ("no_check",)])
def test_a_coarse_encoder_is_not_a_runaway(per_turn: int, fault: tuple[str, ...]) -> None:
    config = Config(sim=SimConfig(encoder_counts=per_turn))
    assert check(*fault, config=config).failed == []


@pytest.mark.variations(3)
@pytest.mark.parametrize("per_turn", [16, 48, 400])
def test_a_late_count_of_a_coarse_encoder_is_not_blamed_on_a_broken_line(per_turn: int) -> None:
    config = Config(sim=SimConfig(encoder_counts=per_turn))
    checked = check("plain_only", "no_watchdog", config=config)
    assert checked["damaged lines"].verdict == "PASS"


@pytest.mark.slow
@pytest.mark.parametrize("lag", [slow(0.8), 1.0])
@pytest.mark.parametrize("fault", ["no_sample", "plain_only"])
def test_a_heavy_wheel_is_neither_a_weak_motor_nor_a_missing_comma(fault: str, lag: float) -> None:
    checked = check(fault, config=Config(sim=SimConfig(motor_time_constant=lag)))
    assert checked.failed == []
    assert checked["trailing comma"].figure == "not needed"
    assert "mcu.trailing_comma" not in checked.changes


@pytest.mark.slow
def test_a_trailing_comma_that_a_heavy_last_wheel_needs_is_found() -> None:
    config = Config(sim=SimConfig(motor_time_constant=0.5))
    checked = check("comma_latched", config=config)
    assert checked["trailing comma"].figure == "needed"


def test_a_wheel_without_an_encoder_is_not_commanded_backward() -> None:
    robot = Robot("plain_only", "stuck_encoder=b")
    Checked(robot)
    assert not any(b"bn" in line for line in robot.sent)


def test_the_question_warns_that_a_faulty_wheel_can_reach_full_speed() -> None:
    assert "dead or reversed can reach full speed" in procedure.CONFIRMATION


def test_every_step_has_a_finding() -> None:
    checked = check(person=True)
    assert not [f for f in checked.findings if f.name == SKIPPED_STEPS]
    names = {"motors" if f.name.startswith("motor ") else f.name for f in checked.findings}
    assert names == set(procedure.STEPS)


# the ten faults

TEN: list[tuple[str, str, str, str, str, dict[str, object]]] = [
    ("swapped_motors=a:b", "motor a", "FAIL", "encoder b", "swap", {}),
    ("reversed_motor=c", "motor c", "FAIL", "counts backward when", "swap", {}),
    ("comma_latched", "trailing comma", "FAIL", "motor d (rear right) still turns after zeros",
     "trailing_comma = true", {"mcu.trailing_comma": True}),
    ("no_watchdog", "watchdog", "FAIL", "run on", "300 ms", {}),
    ("watchdog_fed_by_bad_lines", "watchdog", "FAIL", "half-broken cable", "whole valid line", {}),
    ("late_watchdog", "watchdog", "FAIL", "drives on for 1.0 s", "300 ms", {}),
    ("stuck_encoder=b", "motor b", "FAIL", "the encoder is dead", "watch the wheel", {}),
    ("wrong_baud=57600", "baud rate", "FAIL", "at 57600", "baud_rate = 57600",
     {"mcu.baud_rate": 57600}),
    ("sparse_replies", "reply rate", "FAIL", "one reply every", "reply_period = 0.1",
     {"mcu.reply_period": 0.1}),
    ("spaces", "reply form", "WARN", "ap00.00, bp", "nothing to do", {}),
    ("unpadded", "reply form", "WARN", "ap0.00,bp", "nothing to do", {}),
]  # fmt: skip


@pytest.mark.variations(3)
@pytest.mark.parametrize(("fault", "name", "verdict", "text", "mend", "changes"), TEN)
def test_a_planted_fault_is_found_and_named(
    fault: str, name: str, verdict: str, text: str, mend: str, changes: dict[str, object]
) -> None:
    checked = check(fault)
    finding = checked[name]
    assert finding.verdict == verdict
    assert text in finding.text
    assert mend in finding.mend
    assert changes.items() <= checked.changes.items()
    # Everything that this fault does not affect is judged to be right.
    expected = {"swapped_motors=a:b": 2, "comma_latched": 3}.get(fault, verdict == "FAIL")
    assert len(checked.failed) == expected
    assert not checked.left_turning


def test_a_free_running_board_at_10_hz_gets_a_reply_period_of_0_1_s() -> None:
    checked = check("free_running")
    assert checked["reply rate"].figure == "10 Hz, by its own clock"
    assert checked.changes["mcu.reply_period"] == 0.1


@pytest.mark.variations(3)
@pytest.mark.parametrize("letter", MOTORS)
@pytest.mark.parametrize("part", ["motor", "encoder"])
def test_a_person_who_sees_the_wheel_decides_which_reversed_part_is_named(
    letter: str, part: str
) -> None:
    checked = check("plain_only", f"reversed_{part}={letter}", person=True)
    assert len(checked.failed) == 1
    mend = checked[f"motor {letter}"].mend
    assert ("two leads of motor" if part == "motor" else f"A and B of encoder {letter}") in mend
    assert not any(key.startswith("mcu.wheels") for key in checked.changes)


@pytest.mark.variations(3)
@pytest.mark.parametrize("motor", range(4))
def test_a_wheel_mounted_the_other_way_round_changes_its_sign_in_the_map(motor: int) -> None:
    checked = check("plain_only", f"reversed_wheel={MOTORS[motor]}", person=True)
    assert checked.failed == ["wheel map"]
    wheels = {k: v for k, v in checked.changes.items() if "wheels" in k}
    assert wheels == {f"mcu.wheels.{WHEELS[motor]}": f"-{MOTORS[motor]}"}


@pytest.mark.variations(3)
@pytest.mark.parametrize(("first", "other"), list(combinations(range(4), 2)))
def test_two_swapped_wheels_give_a_changed_wheel_map(first: int, other: int) -> None:
    checked = check("plain_only", f"swapped_wheels={MOTORS[first]}:{MOTORS[other]}", person=True)
    assert checked.failed == ["wheel map"]
    assert checked.changes[f"mcu.wheels.{WHEELS[first]}"] == f"+{MOTORS[other]}"
    assert checked.changes[f"mcu.wheels.{WHEELS[other]}"] == f"+{MOTORS[first]}"


@pytest.mark.variations(3)
@pytest.mark.parametrize("what", ["motors", "encoders"])
@pytest.mark.parametrize(("first", "other"), ["ab", "ac", "bd", "cd"])
def test_crossed_leads_are_named_if_a_person_sees_the_wheels(
    what: str, first: str, other: str
) -> None:
    checked = check("plain_only", f"swapped_{what}={first}:{other}", person=True)
    assert [name.partition(" (")[0] for name in checked.failed] == [
        f"motor {first}",
        f"motor {other}",
    ]
    assert f"{what} {first} and {other}" in checked[f"motor {first}"].mend


def test_the_wheel_map_of_any_wiring_is_found() -> None:
    wired = WheelMap(front_right="-c", front_left="+d", rear_left="-a", rear_right="+b")
    robot = Robot(config=Config(mcu=McuConfig(wheels=wired)), wheels=WheelMap())
    checked = Checked(robot, person=True)
    mapping = {w: checked.changes[f"mcu.wheels.{w}"] for w in WHEELS}
    assert mapping == {w: getattr(wired, w) for w in WHEELS}


@pytest.mark.variations(3)
@pytest.mark.parametrize("part", ["dead_motor", "stuck_encoder"])
@pytest.mark.parametrize("letter", MOTORS)
def test_a_person_who_sees_the_wheel_separates_a_dead_motor_from_a_dead_encoder(
    part: str, letter: str
) -> None:
    checked = check("plain_only", f"{part}={letter}", person=True)
    assert len(checked.failed) == 1
    text = "does not turn" if part == "dead_motor" else "the encoder is dead"
    assert text in checked[f"motor {letter}"].text


def test_an_encoder_that_moves_while_no_wheel_turns_fails_its_motor() -> None:
    robot = Robot("plain_only")

    class Watching(Person):
        def ask(self, question: str, answers: Sequence[str]) -> str | None:
            answer = super().ask(question, answers)
            return "none" if "did motor b turn" in question else answer

    checked = Checked(robot, Watching(robot))
    assert checked.failed == ["motor b (front left)"]
    assert "you saw no wheel turn" in checked["motor b"].text


def test_a_dead_last_motor_is_not_taken_for_a_missing_comma() -> None:
    checked = check("dead_motor=d")
    assert checked["trailing comma"].verdict == "SKIPPED"
    assert "mcu.trailing_comma" not in checked.changes


@pytest.mark.variations(4)
@pytest.mark.parametrize("fault", ["dead_motor=d", "stuck_encoder=d"])
@pytest.mark.parametrize("counts", [16, 48, 150, 400])
def test_a_motor_that_still_coasts_is_not_taken_for_motion_of_the_next_motor(
    counts: int, fault: str
) -> None:
    checked = check("plain_only", fault, config=Config(sim=SimConfig(encoder_counts=counts)))
    assert checked.failed == ["motor d (rear right)"]
    assert "shows nothing" in checked["motor d"].text


@pytest.mark.parametrize("counts", [16, 48, 400])
def test_a_missing_comma_is_found_with_coarse_encoders(counts: int) -> None:
    checked = check("comma_latched", config=Config(sim=SimConfig(encoder_counts=counts)))
    assert checked["trailing comma"].figure == "needed"
    assert checked.changes["mcu.trailing_comma"] is True


@pytest.mark.parametrize("counts", [16, 48, 96])
def test_the_check_asks_about_a_wheel_with_a_coarse_encoder_only_when_it_stands(
    counts: int,
) -> None:
    """The simulated person fails the test if a wheel still turns when the check asks."""
    config = Config(sim=SimConfig(encoder_counts=counts))
    assert check("plain_only", config=config, person=True).failed == []


def test_old_firmware_with_its_comma_configured_fails_only_on_broken_lines() -> None:
    checked = check("comma_latched", trailing_comma=True)
    assert checked.failed == ["watchdog", "damaged lines"]
    assert "damaged lines keep it from acting" in checked["watchdog"].figure


def test_several_faults_at_once_are_all_found() -> None:
    checked = check(
        "comma_latched", "wrong_baud=57600", "reversed_motor=a", "stuck_encoder=b", "spaces",
        "no_watchdog", "reversed_wheel=c", person=True,
    )  # fmt: skip
    assert [name.partition(" (")[0] for name in checked.failed] == [
        "baud rate", "motor a", "motor b", "trailing comma", "wheel map", "watchdog",
        "damaged lines",
    ]  # fmt: skip
    assert checked.named("WARN") == ["reply form"]
    assert checked.changes == {
        "mcu.baud_rate": 57600,
        "mcu.trailing_comma": True,
        "mcu.wheels.rear_left": "-c",
    }
    assert not checked.left_turning


# safety of the check


def zero(line: bytes) -> bool:
    return line in (Codec(WheelMap()).stop, Codec(WheelMap(), True).stop, b"\r\n")


def test_only_zeros_are_sent_until_the_wheels_are_confirmed_to_be_lifted() -> None:
    robot = Robot()

    class Refuses(Nobody):
        def ask(self, question: str, answers: Sequence[str]) -> str | None:
            assert all(zero(line) for data in robot.sent for line in data.splitlines(True))
            assert answers == ("lifted",)
            return None

    findings: list[Finding] = []
    procedure.run(robot, Refuses(), robot.config, findings.append)
    assert [finding.name for finding in findings if finding.verdict != "SKIPPED"] == ["wheels"]
    assert all(zero(line) for data in robot.sent for line in data.splitlines(True))
    assert not robot.is_open


@pytest.mark.parametrize("typed", ["q\n", "Q\n"])
def test_a_q_typed_while_a_motor_turns_ends_the_check(typed: str) -> None:
    """The operator holds the key, so further keys arrive while the check sends its last zeros."""
    robot = Robot("no_watchdog")
    questions: list[str] = []

    class Quits(Person):
        def keys(self, wait_s: float) -> str:
            return typed if any(robot.mcu.vehicle.set_points) else ""

        def ask(self, question: str, answers: Sequence[str]) -> str | None:
            questions.append(question)
            return super().ask(question, answers)

    with robot.faulty(), pytest.raises(KeyboardInterrupt):
        procedure.run(robot, Quits(robot), robot.config, lambda finding: None)
    assert questions == [procedure.CONFIRMATION]
    assert b"".join(robot.sent[-5:]).count(Codec(WheelMap()).stop) == FINAL_ZEROS
    assert robot.later() == [0.0] * 4


def test_another_word_typed_while_a_motor_turns_does_not_end_the_check() -> None:
    class Types(Person):
        def keys(self, wait_s: float) -> str:
            return "none\n"

    robot = Robot()
    assert Checked(robot, Types(robot)).failed == []


class Stalls(Robot):
    """A robot whose check stalls once, while all motors in `turning` have a set point.

    If `turning` has more than four motors, the check stalls when a test calls `stall`. The
    monotonic clock advances in the stall unless the computer is `asleep`.
    """

    def __init__(self, seconds: float, *, asleep: bool = False, turning: int = 5) -> None:
        super().__init__()
        self._seconds, self._asleep, self._turning = seconds, asleep, turning
        self.asleep_ns = 0
        self.stalled = False
        self.turned_after: list[bytes] = []
        """Lines after the stall that turn a motor."""

    def send(self, data: bytes) -> None:
        if self.stalled and re.search(rb"[1-9]", data.partition(b"#")[0]):
            self.turned_after.append(data)
        super().send(data)

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        if self.stalled or sum(map(bool, self.mcu.vehicle.set_points)) < self._turning:
            return super().listen(until_ns)
        return self.stall(until_ns)

    def stall(self, until_ns: int = 0) -> list[tuple[int, bytes]]:
        """Stall the check for the given seconds.

        The stall starts at `until_ns`, or now if that is later.
        """
        self.stalled = True
        stall_ns = int(self._seconds * 1e9)
        if self._asleep:
            self.mcu.vehicle.set_points[:] = [0.0] * 4  # the watchdog stopped the motors
            self.asleep_ns = stall_ns
            return super().listen(until_ns)
        return super().listen(max(until_ns, self.now_ns()) + stall_ns)


@pytest.mark.parametrize("asleep", [False, True], ids=["stopped", "suspended"])
@pytest.mark.parametrize("turning", [1, 2])
def test_a_check_that_stalled_while_a_motor_turned_turns_no_motor_again(
    turning: int, asleep: bool
) -> None:
    robot = Stalls(60.0, asleep=asleep, turning=turning)
    questions: list[str] = []

    class Away(Person):
        def ask(self, question: str, answers: Sequence[str]) -> str | None:
            assert not robot.stalled
            questions.append(question)
            return super().ask(question, answers)

    findings: list[Finding] = []
    procedure.run(robot, Away(robot), robot.config, findings.append, lambda: robot.asleep_ns)
    assert robot.stalled
    assert robot.turned_after == []
    stopped, rest = findings[-2:]
    assert (stopped.name, stopped.verdict) == ("stall", "FAIL")
    assert stopped.figure == "stood still for 60.0 s"
    assert "suspended or overloaded" in stopped.mend
    assert rest.text.startswith("the check ended early: stall; not finished: ")
    assert robot.later() == [0.0] * 4
    assert (len(questions) > 1) == (turning > 1)


@pytest.mark.parametrize("asleep", [False, True], ids=["stopped", "suspended"])
@pytest.mark.parametrize("at", ["motor b", "wheel map", "encoder counts"])
def test_after_a_stall_of_the_terminal_the_check_sends_no_line_that_turns_a_motor(
    at: str, asleep: bool
) -> None:
    """The terminal stalls while it shows what the check does next, or a finding."""
    robot = Stalls(60.0, asleep=asleep)

    class Watches(Person):
        def doing(self, text: str) -> None:
            super().doing(text)
            shows(text)

    def shows(text: str) -> None:
        if text.startswith(at) and not robot.stalled:
            robot.stall()

    findings: list[Finding] = []

    def tell(finding: Finding) -> None:
        findings.append(finding)
        shows(finding.name)

    procedure.run(robot, Watches(robot), robot.config, tell, lambda: robot.asleep_ns)
    assert robot.stalled
    assert robot.turned_after == []
    assert [finding.name for finding in findings[-2:]] == ["stall", SKIPPED_STEPS]


@pytest.mark.parametrize("asleep", [False, True], ids=["stopped", "suspended"])
@pytest.mark.parametrize(("seconds", "ends"), [(0.6, False), (4.5, False), (60.0, True)])
def test_before_a_wheel_has_turned_only_a_long_stall_ends_the_check(
    seconds: float, ends: bool, asleep: bool
) -> None:
    robot, findings = Stalls(seconds, asleep=asleep, turning=0), list[Finding]()
    procedure.run(robot, Nobody(), robot.config, findings.append, lambda: robot.asleep_ns)
    assert robot.stalled
    failed = [finding.name for finding in findings if finding.verdict in ("FAIL", "WARN")]
    assert failed == (["stall"] if ends else [])
    assert bool(robot.turned_after) != ends


def test_a_step_spoilt_by_a_suspend_before_a_wheel_has_turned_is_repeated() -> None:
    class Loses(Stalls):
        """A robot whose replies are lost after a suspend, while the check counts lost lines."""

        counts, waits = False, 0

        def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
            self.waits += self.counts
            chunks = self.stall(until_ns) if self.waits == 60 else super().listen(until_ns)
            return [] if 60 <= self.waits < 80 else chunks

    class Reads(Nobody):
        def doing(self, text: str) -> None:
            robot.counts |= text.startswith("counting lost lines")

    robot, findings = Loses(2.0, asleep=True), dict[str, Finding]()

    def tell(finding: Finding) -> None:
        findings[finding.name] = finding

    procedure.run(robot, Reads(), robot.config, tell, lambda: robot.asleep_ns)
    assert robot.stalled
    assert findings["lost lines"].figure.startswith("none of ")


class Trouble(Robot):
    """A robot that raises an error at the n-th line."""

    def __init__(self, number: int, error: BaseException, *faults: str) -> None:
        super().__init__(*faults)
        self._number, self._error = number, error

    def send(self, data: bytes) -> None:
        super().send(data)
        if len(self.sent) == self._number:
            raise self._error


LINES = 560
"""Nearly as many lines as a whole check sends."""


@pytest.mark.variations(3)
@pytest.mark.parametrize("fault", ["no_sample", "comma_latched"])
@pytest.mark.parametrize("number", range(2, LINES, 43))
def test_whatever_ends_the_check_the_last_lines_are_zeros_in_both_forms(
    fault: str, number: int
) -> None:
    error = KeyboardInterrupt if number % 2 else RuntimeError
    robot = Trouble(number, error(), fault, "no_watchdog")
    with robot.faulty(), pytest.raises(error):
        procedure.run(robot, Nobody(), robot.config, lambda finding: None)
    last = b"".join(robot.sent[-5:])
    assert last.count(Codec(WheelMap()).stop) == last.count(Codec(WheelMap(), True).stop) == 5
    with robot.faulty():
        assert robot.later() == [0.0] * 4
    assert not robot.is_open


def test_a_signal_during_the_last_zeros_does_not_stop_them() -> None:
    class Interrupted(Robot):
        interrupted = False

        def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
            last = self.sent[-1].startswith(b"\r\nap") and len(self.sent) > 100
            if last and not self.interrupted:
                self.interrupted = True
                raise KeyboardInterrupt
            return super().listen(until_ns)

    robot = Interrupted("plain_only")
    with robot.faulty(), pytest.raises(KeyboardInterrupt):
        procedure.run(robot, Nobody(), robot.config, lambda finding: None)
    assert b"".join(robot.sent[-5:]).count(Codec(WheelMap(), True).stop) == 5
    assert not robot.is_open


def test_a_listener_that_fails_ends_the_check_with_zeros() -> None:
    robot = Robot("no_watchdog")

    def tell(finding: Finding) -> None:
        raise BrokenPipeError

    with robot.faulty(), pytest.raises(BrokenPipeError):
        procedure.run(robot, Nobody(), robot.config, tell)
    assert robot.later() == [0.0] * 4


def test_a_person_who_quits_at_a_question_leaves_a_standing_robot() -> None:
    robot = Robot("no_watchdog", "comma_latched")

    class Leaves(Nobody):
        def ask(self, question: str, answers: Sequence[str]) -> str | None:
            if len(answers) > 1:
                raise KeyboardInterrupt
            return answers[0]

    with robot.faulty(), pytest.raises(KeyboardInterrupt):
        procedure.run(robot, Leaves(), robot.config, lambda finding: None)
    assert robot.later() == [0.0] * 4


@pytest.mark.variations(3)
@pytest.mark.parametrize("number", [5, 200, 400])
def test_a_lost_port_is_a_finding_and_the_other_steps_are_skipped(number: int) -> None:
    robot = Trouble(number, WireLostError("unplugged"))
    checked = Checked(robot)
    assert checked.failed == ["serial line"]
    assert checked.findings[-1].verdict == "SKIPPED"
    assert not robot.is_open


def test_a_runaway_ends_the_check_before_any_faster_command() -> None:
    robot = Robot("bias=b:3")
    checked = Checked(robot)
    assert checked.failed == ["runaway"]
    assert "more than 6 rad/s" in checked["runaway"].text
    assert "watchdog" in checked[SKIPPED_STEPS].text
    motors = "motor b (front left), motor c (rear left), motor d (rear right)"
    assert f"not finished: {motors}, trailing comma, " in checked[SKIPPED_STEPS].text
    speeds = [max(float(token[2:7]) for token in line.split(b",")[:4])
            for _, line in robot.mcu.heard if line.startswith(b"a")]  # fmt: skip
    # Motor a was commanded its 3 rad/s. Motor b got no command above the speed that already looked
    # like a runaway.
    assert max(speeds) <= 3.0
    assert not checked.left_turning


class Regulates(Robot):
    """A robot whose firmware controls the speed with the encoder's feedback.

    A motor with a dead encoder therefore runs to full speed. A motor with a reversed encoder does
    so even at a command of zero, unless it stands still. Only the watchdog stops these motors.
    """

    FULL = 20.0

    def __init__(self, *faults: str, lag: float = 0.3) -> None:
        super().__init__(*faults, config=Config(sim=SimConfig(motor_time_constant=lag)))
        self.full_s = 0.0
        """Time for which a motor was faster than 6 rad/s, in seconds."""
        self.mcu.understand = self._regulated

    def _regulated(self, line: bytes) -> protocol.Command | None:
        command = protocol.reference(line)
        if command is None:
            return None
        for motor, target in command.values.items():
            sign = 0 if self.mcu.stuck == motor else self.mcu.encoder_signs[motor]
            speed = self.mcu.vehicle.speeds[motor]
            error = target - sign * speed
            if sign != 1 and abs(error) > 0.1:
                command.values[motor] = math.copysign(self.FULL, error)
        return command

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        chunks, step_ns = [], 5 * MS
        while self.now_ns() < until_ns:
            chunks += super().listen(min(until_ns, self.now_ns() + step_ns))
            self.full_s += 0.005 * any(abs(v) > 6.0 for v in self.mcu.vehicle.speeds)
        return chunks


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "most_s"), [("stuck_encoder=b", 0.8), ("reversed_encoder=b", 0.9)]
)
def test_firmware_that_regulates_is_not_left_at_full_speed(fault: str, most_s: float) -> None:
    robot = Regulates(fault)
    checked = Checked(robot)
    assert checked.failed == ["motor b (front left)"]
    assert checked["motor b"].figure.endswith("probed")
    assert checked["watchdog"].verdict == "PASS"
    assert robot.full_s < most_s
    assert not checked.left_turning


def zeros_after(sent: Sequence[bytes]) -> int:
    """Return the number of lines after the last line that commands a speed."""
    return next(n for n, line in enumerate(reversed(sent)) if b"3.00" in line)


def test_after_a_runaway_zeros_are_sent_once_and_then_nothing() -> None:
    robot = Robot("bias=b:3")
    Checked(robot)
    assert zeros_after(robot.sent) == 1
    assert robot.sent[-1].startswith(b"\r\nap00.00")


def test_a_motor_that_runs_away_on_zeros_is_left_to_the_watchdog() -> None:
    robot = Regulates("reversed_encoder=b", lag=0.05)
    with robot.board() as board:
        board.drive((0.0, SPEED, 0.0, 0.0), 0.05)
    assert 1 <= zeros_after(robot.sent) < FINAL_ZEROS
    assert not any(robot.later())


def test_an_mcu_that_restarts_once_while_a_motor_turns_is_checked_to_the_end() -> None:
    class Restarts(Robot):
        restarts = 0

        def send(self, data: bytes) -> None:
            super().send(data)
            if not self.restarts and self.mcu.vehicle.speeds[1] > 2.0:
                self.restarts = 1
                self.mcu.reset(self.now_ns())

    checked = Checked(Restarts())
    assert checked.failed == ["restarts"]
    assert "supply" in checked["restarts"].mend
    assert checked["damaged lines"].verdict == "PASS"


def test_an_echo_is_not_taken_for_a_robot() -> None:
    class Echo(Robot):
        def send(self, data: bytes) -> None:
            self.sent.append(data)
            self.echo = getattr(self, "echo", b"") + data

        def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
            data, self.echo = getattr(self, "echo", b""), b""
            super().listen(until_ns)
            return [(self.now_ns(), data)] if data else []

    checked = Checked(Echo())
    assert checked.failed == ["identification"]
    assert checked["identification"].figure == "an echo"


@pytest.mark.parametrize(
    ("fault", "mend", "text"),
    [
        ("mute", "TX and RX swapped", "nothing was received"),
        ("noise", "ground", r"`\x00\xff~ap00.00,bp00.00"),
        ("partial_line", "line end", "bytes received but no line end; the last bytes are `"),
    ],
)
def test_an_mcu_without_a_valid_line_is_never_driven_and_its_bytes_are_reported(
    fault: str, mend: str, text: str
) -> None:
    robot = Robot(fault)
    checked = Checked(robot)
    assert checked.failed == ["baud rate"]
    assert mend in checked["baud rate"].mend
    assert text in checked["baud rate"].text
    (rest,) = [finding for finding in checked.findings if finding.verdict == "SKIPPED"]
    assert rest is checked.findings[-1]
    assert all(step in rest.text for step in procedure.STEPS[1:])
    assert robot.mcu.vehicle.angles == [0.0] * 4
    assert set(robot.opened) == {9600, 19200, 38400, 57600, 115200}


@pytest.mark.variations(3)
@pytest.mark.parametrize("gain", [0.8, 0.93, 1.07])
def test_a_motor_that_is_off_by_more_than_a_twentieth_is_a_warning(gain: float) -> None:
    checked = check(f"bias=c:{gain}")
    assert checked.failed == []
    assert checked.named("WARN") == ["motor c (rear left)"]
    assert checked["watchdog"].verdict == "PASS"


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    "robot", [(0.2, 3200), (1.0, 3200), slow((0.05, 16)), (0.05, 48), slow((0.5, 64))]
)
def test_neither_a_heavy_wheel_nor_a_coarse_encoder_is_a_weak_motor(
    robot: tuple[float, int],
) -> None:
    lag, per_turn = robot
    config = Config(sim=SimConfig(motor_time_constant=lag, encoder_counts=per_turn))
    checked = check("plain_only", config=config)
    assert not [name for name in checked.named("WARN") if name.startswith("motor")]


def test_each_step_is_announced_before_it_takes_time() -> None:
    texts: list[str] = []

    class Listener(Nobody):
        def doing(self, text: str) -> None:
            texts.append(text)

    robot = Robot()
    procedure.run(robot, Listener(), robot.config, lambda finding: texts.append(finding.name))
    indices = [n for n, text in enumerate(texts) if text in ("baud rate", "lost lines", "watchdog")]
    assert all(texts[n - 1] not in procedure.STEPS for n in indices)
    turned = [text.split()[1] for text in texts if " turns: briefly" in text]
    assert turned == list(MOTORS)


@pytest.mark.variations(3)
@pytest.mark.parametrize("fault", ["lost_replies", "lost_commands", "bit_errors", "slow_reply"])
def test_a_check_over_a_poor_line_leaves_no_motor_turning(fault: str) -> None:
    assert not check(fault).left_turning


def test_the_check_waits_for_a_board_that_boots_when_the_port_opens() -> None:
    robot = Robot()
    robot.mcu.reset(0, 2 * NS_PER_S)
    assert Checked(robot).failed == []


def test_no_motor_is_commanded_above_3_rad_s_or_for_4_s() -> None:
    robot = Robot("plain_only", "no_watchdog")
    Checked(robot)
    turning_since: dict[str, int] = {}
    for at_ns, line in robot.mcu.heard:
        tokens = line.rstrip(b",\r\n").split(b",")
        if len(tokens) != 4 or not line.startswith(b"a") or b"x" in line:
            continue
        speeds = [float(token[2:7]) for token in tokens if len(token) == 7]
        assert max(speeds) <= 3.0
        moving = any(speeds)
        since = turning_since.setdefault("on", at_ns)
        if not moving:
            turning_since.clear()
        assert at_ns - since < 4000 * MS


def test_a_last_motor_that_obeys_zeros_only_with_a_comma_needs_the_trailing_comma() -> None:
    def obeys(line: bytes) -> protocol.Command | None:
        """Parse lines without a final comma, but accept a zero for motor d only with this comma."""
        command = None if b"#" in line else protocol.reference(line)
        if command and not command.values[3] and not line.endswith(b",\r\n"):
            command.values.pop(3)
        return command

    robot = Robot()
    robot.mcu.understand = obeys
    checked = Checked(robot)
    finding = checked["trailing comma"]
    assert (finding.verdict, finding.figure) == ("FAIL", "needed")
    assert "still turns after zeros" in finding.text
    assert checked.changes["mcu.trailing_comma"] is True


# a computer that runs late


def names(checked: Checked) -> set[str]:
    """Return the names of the findings that were not judged."""
    return {f.name for f in checked.findings if f.figure == "not judged"}


@pytest.mark.variations(10)
@pytest.mark.parametrize(
    ("computer", "fault", "late_s", "every"),
    [
        (Busy, "no_sample", 0.04, 2),
        (Busy, "plain_only", 0.15, 5),
        (Starved, "no_sample", 0.4, 40),
        (Busy, "free_running", 0.06, 3),
        (Busy, "no_sample", 0.4, 11),
        (Starved, "free_running", 0.15, 9),
        (Starved, "plain_only", 0.06, 3),
        (Starved, "plain_only", 0.4, 11),
        (Busy, "no_sample", 0.03, 1),
        (Starved, "no_sample", 0.15, 9),
    ],
)
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


@pytest.mark.slow
def test_lost_lines_of_a_board_without_a_measured_reply_rate_are_not_judged() -> None:
    """A free-running board does not answer each line, so missing replies prove no loss."""
    unpaced = 0
    for until_s in range(2, 10):
        late = Busy(
            "free_running", "plain_only", late_s=0.45, every=9, until_s=until_s, reply_period=0.1
        )
        checked = Checked(late)
        if "reply rate" in names(checked):
            unpaced += 1
            assert {"round trip", "lost lines"} <= names(checked)
        assert checked.failed == []
    assert unpaced


@pytest.mark.slow
def test_the_person_is_asked_once_about_a_motor_that_is_checked_again() -> None:
    robot = Busy("plain_only", late_s=0.45, every=30)
    asked: list[str] = []

    class Counts(Person):
        def ask(self, question: str, answers: Sequence[str]) -> str | None:
            asked.append(question.partition("?")[0])
            return super().ask(question, answers)

    findings: list[Finding] = []
    procedure.run(robot, Counts(robot), robot.config, findings.append)
    which = [question for question in asked if question.startswith("which wheel")]
    assert len(which) == len(set(which))


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


def test_a_board_that_falls_silent_fails_despite_small_delays_of_the_host() -> None:
    class Pulled(Busy):
        def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
            chunks = super().listen(until_ns)
            return [] if self.turned else chunks

    robot = Pulled("plain_only", late_s=0.03, every=5)
    checked = Checked(robot)
    assert checked.failed == ["link"]


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


@pytest.mark.slow
def test_a_motor_that_was_not_judged_does_not_fail_the_watchdog() -> None:
    checked = Checked(Busy("dead_motor=b", late_s=0.45, every=3))
    assert "motor b (front left)" in names(checked)
    assert checked["watchdog"].verdict in ("SKIPPED", "WARN")


@pytest.mark.variations(6)
@pytest.mark.parametrize("computer", [Busy, Starved])
@pytest.mark.parametrize(
    ("fault", "name"),
    [
        ("late_watchdog", "watchdog"),
        ("watchdog_fed_by_bad_lines", "watchdog"),
        ("bias=a:1.5", "motor a (front right)"),
    ],
)
def test_a_fault_beyond_what_the_lateness_explains_is_reported(
    computer: type[Busy], fault: str, name: str
) -> None:
    checked = Checked(computer(fault, late_s=0.03, every=3))
    assert checked[name].verdict == "FAIL"
    assert type(checked[name]) is Finding  # programs receive no further fields


def test_a_later_step_reports_a_fault_that_an_earlier_step_could_not_judge() -> None:
    class Refuses(Busy):
        """A robot that ignores lines without a comma, on a computer that is late in one step."""

        looked = False

        def wakes_late(self) -> bool:
            return self.looked and super().wakes_late()

    def obeys(line: bytes) -> protocol.Command | None:
        command = None if b"#" in line else protocol.reference(line)
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
    robot.mcu.understand = obeys
    findings: list[Finding] = []
    with robot.faulty():
        robot.mcu.understand = obeys
        procedure.run(robot, Sees(), robot.config, findings.append)
    matches = [finding for finding in findings if finding.name == "trailing comma"]
    assert [finding.figure for finding in matches] == ["not judged", "needed"]
    assert matches[1].keys == {"mcu.trailing_comma": True}
