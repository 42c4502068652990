"""Whatever ends a check, and whatever the board does, its motors stand still afterward."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import pytest
from msgspec import structs
from msgspec.structs import replace

from acsard.checkup import procedure
from acsard.checkup.board import FINAL_ZEROS
from acsard.checkup.findings import Finding, WireLostError, motor_name
from acsard.core.config.motion_rules import top_wheel_speed
from acsard.core.config.settings import Config, SimConfig
from acsard.core.link.codec import MotorCodec
from acsard.core.simulator import protocol
from tests.unit.checkup_robots import (
    FOUR_AND_TWO,
    MS,
    Checked,
    Nobody,
    Person,
    Robot,
)


def stop_lines(config: Config) -> tuple[bytes, bytes]:
    """Return the lines of zeros of the motors, without and with a comma at the end."""
    letters = config.mcu.wheels.letters
    return MotorCodec(letters).stop, MotorCodec(letters, True).stop


@FOUR_AND_TWO
def test_only_zeros_are_sent_until_the_wheels_are_confirmed_to_be_lifted(config: Config) -> None:
    robot, zeros = Robot(config=config), (*stop_lines(config), b"\r\n")

    class Refuses(Nobody):
        def ask(self, question: str, answers: Sequence[str]) -> str | None:
            assert all(line in zeros for data in robot.sent for line in data.splitlines(True))
            assert answers == ("lifted",)
            return None

    findings: list[Finding] = []
    procedure.run(robot, Refuses(), robot.config, findings.append, fast=True)
    assert [finding.name for finding in findings if finding.verdict != "SKIPPED"] == ["wheels"]
    assert all(line in zeros for data in robot.sent for line in data.splitlines(True))
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
        procedure.run(robot, Quits(robot), robot.config, lambda finding: None, fast=True)
    top = top_wheel_speed(robot.config)
    assert questions == [procedure.CONFIRMATION.format(top=top)]
    assert b"".join(robot.sent[-5:]).count(stop_lines(robot.config)[0]) == FINAL_ZEROS
    assert robot.later() == [0.0] * 4


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
    procedure.run(
        robot, Away(robot), robot.config, findings.append, lambda: robot.asleep_ns, fast=True
    )
    assert robot.stalled
    assert robot.turned_after == []
    stopped, rest = findings[-2:]
    assert (stopped.name, stopped.verdict) == ("stall", "FAIL")
    assert stopped.figure == "stood still for 60.0 s"
    assert "suspended or overloaded" in stopped.mend
    assert rest.text.startswith("the check ended early: stall; not finished: ")
    assert robot.later() == [0.0] * 4
    assert (len(questions) > 1) == (turning > 1)


@pytest.mark.variations(7)
@pytest.mark.parametrize("asleep", [False, True], ids=["stopped", "suspended"])
@pytest.mark.parametrize(("seconds", "ends"), [(0.6, False), (4.5, False), (60.0, True)])
def test_before_a_wheel_has_turned_only_a_long_stall_ends_the_check(
    seconds: float, ends: bool, asleep: bool
) -> None:
    robot, findings = Stalls(seconds, asleep=asleep, turning=0), list[Finding]()
    procedure.run(
        robot, Nobody(), robot.config, findings.append, lambda: robot.asleep_ns, fast=True
    )
    assert robot.stalled
    failed = [finding.name for finding in findings if finding.verdict in ("FAIL", "WARN")]
    assert failed == (["stall"] if ends else [])
    assert bool(robot.turned_after) != ends


class Trouble(Robot):
    """A robot that raises an error at the n-th line."""

    def __init__(self, number: int, error: BaseException, *faults: str, **how: Any) -> None:
        super().__init__(*faults, **how)
        self._number, self._error = number, error

    def send(self, data: bytes) -> None:
        super().send(data)
        if len(self.sent) == self._number:
            raise self._error


@pytest.mark.variations(3)
@FOUR_AND_TWO
@pytest.mark.parametrize("fault", ["no_sample", "comma_latched"])
@pytest.mark.parametrize("number", range(2, 560, 43))
def test_whatever_ends_the_check_the_last_lines_are_zeros_in_both_forms(
    fault: str, number: int, config: Config
) -> None:
    error = KeyboardInterrupt if number % 2 else RuntimeError
    robot = Trouble(number, error(), fault, "no_watchdog", config=config)
    with robot.faulty(), pytest.raises(error):
        procedure.run(robot, Nobody(), robot.config, lambda finding: None, fast=True)
    last = b"".join(robot.sent[-5:])
    assert [last.count(line) for line in stop_lines(config)] == [5, 5]
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
        procedure.run(robot, Nobody(), robot.config, lambda finding: None, fast=True)
    assert b"".join(robot.sent[-5:]).count(stop_lines(robot.config)[1]) == 5
    assert not robot.is_open


@pytest.mark.variations(3)
@pytest.mark.parametrize("number", [5, 200, 400])
def test_a_lost_port_is_a_finding_and_the_other_steps_are_skipped(number: int) -> None:
    robot = Trouble(number, WireLostError("unplugged"))
    checked = Checked(robot)
    assert checked.failed == ["serial line"]
    assert checked.findings[-1].verdict == "SKIPPED"
    assert not robot.is_open


class Regulates(Robot):
    """A robot whose firmware controls the speed with the encoder's feedback.

    A motor with a dead encoder therefore runs to full speed. A motor with a reversed encoder does
    so even at a command of zero, unless it stands still. Only the watchdog stops these motors.
    """

    FULL = 20.0

    def __init__(self, *faults: str, config: Config, lag: float = 0.3) -> None:
        super().__init__(
            *faults, config=structs.replace(config, sim=SimConfig(motor_time_constant=lag))
        )
        self.full_s = 0.0
        """Time for which a motor was faster than 6 rad/s, in seconds."""
        self.mcu.switches.firmware = "plain_only"
        vars(self.mcu)["understand"] = self._regulated

    def _regulated(self, line: bytes) -> protocol.BoardCommand | None:
        command = protocol.reference(line, self.mcu.letters)
        if command is None:
            return None
        for motor, target in command.values.items():
            sign = 0 if self.mcu.switches.stuck == motor else self.mcu.switches.encoder_signs[motor]
            (wheel, *_), _ = self.mcu._wiring[motor]
            speed = self.mcu.vehicle.speeds[wheel]
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
@FOUR_AND_TWO
@pytest.mark.parametrize(("fault", "most_s"), [("stuck_encoder", 0.8), ("reversed_encoder", 0.9)])
def test_firmware_that_regulates_is_not_left_at_full_speed(
    fault: str, most_s: float, config: Config
) -> None:
    motor = len(config.mcu.wheels.names) - 2  # for the last motor the check tries both line ends
    name = motor_name(config.mcu, motor)
    # The step of the highest speed then commands no more than the others.
    limits = replace(config.limits, linear_speed=0.1, angular_speed=0.1)
    config = replace(config, limits=limits)
    robot = Regulates(f"{fault}={config.mcu.wheels.letters[motor]}", config=config)
    checked = Checked(robot)
    assert checked.failed == [name]
    assert checked[name].figure.endswith("probed")
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


@FOUR_AND_TWO
def test_without_a_watchdog_no_motor_is_commanded_above_3_rad_s_or_for_4_s(config: Config) -> None:
    robot = Robot("plain_only", "no_watchdog", config=config)
    Checked(robot)
    letters = config.mcu.wheels.letters
    turning_since: dict[str, int] = {}
    for at_ns, line in robot.mcu.heard:
        tokens = line.rstrip(b",\r\n").split(b",")
        if len(tokens) != len(letters) or line[:1] != letters[:1].encode() or b"x" in line:
            continue
        speeds = [float(token[2:7]) for token in tokens if len(token) == 7]
        assert max(speeds) <= 3.0
        moving = any(speeds)
        since = turning_since.setdefault("on", at_ns)
        if not moving:
            turning_since.clear()
        assert at_ns - since < 4000 * MS
