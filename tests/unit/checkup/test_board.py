"""Tests of the board: lines it sends, lines it accepts as answers, and reasons to end a check."""

from __future__ import annotations

import pytest

from acsard.checkup.board import Board, Operator, Wire
from acsard.checkup.findings import StoppedError
from acsard.checkup.motion import MOTOR_TIMEOUT_S, SLOWING_TIMEOUT_S, SPEED, ZERO
from acsard.core.config.settings import Config, McuConfig, SimConfig
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.simulator.virtual_wire import VirtualWire
from acsard.host.errors import MendableError
from tests.unit.checkup.robots import Nobody, Robot


def test_no_line_is_sent_if_the_serial_line_does_not_open() -> None:
    class Held(Robot):
        def open(self, baud_rate: int) -> None:
            raise MendableError("held")

    robot = Held()
    with pytest.raises(MendableError), Board(robot, McuConfig(), 100.0):
        pass
    assert robot.sent == []


def test_a_line_commands_motors_whatever_wheels_are_configured() -> None:
    robot = Robot()
    with robot.board() as board:
        assert board.line((1.0, -2.0, 0.0, 3.0)) == b"ap01.00,bn02.00,cp00.00,dp03.00\r\n"
        assert board.line((1.0, -2.0, 0.0, 3.0), True).endswith(b"dp03.00,\r\n")
        board.sealed = board.sampled = True
        assert board.line(ZERO).startswith(b"ap00.00,bp00.00,cp00.00,dp00.00#01S*")


def test_driving_returns_a_reply_to_every_line_with_the_measured_speeds() -> None:
    robot = Robot()
    with robot.board() as board:
        before = len(robot.sent)
        replies = board.drive((SPEED, 0.0, 0.0, 0.0), 0.5)
        assert len(replies) >= len(robot.sent) - before - 2 >= 20
        assert replies[-1].motors[0] == pytest.approx(SPEED, abs=0.2)
        assert replies[-1].motors[1:] == (0.0, 0.0, 0.0)
        assert board.turning() == [0]
        board.stop_motors()
        assert board.turning() == []


def test_replies_have_the_time_at_which_they_were_complete() -> None:
    robot = Robot()
    with robot.board() as board:
        replies = board.drive(ZERO, 0.3)
        times = [reply.at_s for reply in replies]
        assert times == sorted(times)
        assert times[-1] <= board.now_s


@pytest.mark.parametrize("sent", [False, True])
def test_a_last_motor_that_keeps_its_speed_is_stopped_by_the_other_comma(sent: bool) -> None:
    robot = Robot("comma_latched", trailing_comma=sent)
    with robot.board() as board:
        board.comma = True
        board.drive((0.0, 0.0, 0.0, SPEED), 0.3)
        board.comma = sent
        board.stop_motors()
        assert board.latched is not sent
        assert board.comma
    assert robot.later() == [0.0] * 4


def test_a_motor_that_zeros_do_not_stop_ends_the_check() -> None:
    class Deaf(Robot):
        def send(self, data: bytes) -> None:
            super().send(data)
            if self.mcu.vehicle.speeds[0] > 2.0:
                self.mcu.understand = lambda line: None

    robot = Deaf("no_watchdog", "free_running")
    with robot.board() as board:
        board.drive((SPEED, 0.0, 0.0, 0.0), 0.3)
        with pytest.raises(StoppedError) as end:
            board.stop_motors()
        sent = len(robot.sent)
    assert end.value.finding.name == "stop"
    assert f"{2 * MOTOR_TIMEOUT_S:g} s" in end.value.finding.figure
    assert "motor a (front right)" in end.value.finding.text
    assert robot.sent[-1].startswith(b"\r\n")  # one line, then silence
    assert not robot.sent[-2].startswith(b"\r\n")
    assert len(robot.sent) == sent


def test_a_message_names_the_motors_that_turn_after_the_second_attempt_to_stop() -> None:
    class Blocked(Robot):
        """A robot on which a hand stops motor b after 3 s, while motor a turns on."""

        def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
            super().listen(until_ns)
            b = "bp03.00" if until_ns < 3e9 else "bp00.00"
            return [(until_ns, f"ap03.00,{b},cp00.00,dp00.00\r\n".encode())]

    with Board(Blocked("mute"), McuConfig(), 100.0) as board, pytest.raises(StoppedError) as end:
        board.stop_motors()
    assert end.value.finding.name == "stop"
    assert "motor a (front right)" in end.value.finding.text
    assert "motor b" not in end.value.finding.text


def test_a_board_that_falls_silent_while_its_motors_must_stop_is_reported_as_silent() -> None:
    robot = Robot("plain_only")
    with robot.board() as board:
        board.drive((SPEED, 0.0, 0.0, 0.0), 0.3)
        with robot.mcu.mute(), pytest.raises(StoppedError) as end:
            board.stop_motors()
        assert not board.runaway_seen
        assert board.silent_s == pytest.approx(2 * MOTOR_TIMEOUT_S, abs=0.1)
    assert end.value.finding.name == "link"
    assert end.value.finding.figure == f"silent for {2 * MOTOR_TIMEOUT_S:.1f} s"
    assert "while this computer sent it only zeros" in end.value.finding.text


def test_a_board_that_ignores_lines_with_the_other_ending_is_not_reported_as_silent() -> None:
    class Picky(Robot):
        """A robot that does not stop, and whose replies end after 2 s."""

        def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
            super().listen(until_ns)
            line = b"ap03.00,bp00.00,cp00.00,dp00.00\r\n"
            return [(until_ns, line)] if until_ns < MOTOR_TIMEOUT_S * 1e9 else []

    with Board(Picky("mute"), McuConfig(), 100.0) as board, pytest.raises(StoppedError) as end:
        board.stop_motors()
    assert end.value.finding.name == "stop"
    assert "motor a (front right)" in end.value.finding.text


def test_one_damaged_reply_is_not_a_runaway_but_three_are() -> None:
    robot = Robot("mute")
    wild = b"ap80.00,bp00.00,cp00.00,dp00.00\r\n"
    still = wild.replace(b"80", b"00")

    def answered(*lines: bytes) -> None:
        board = Board(robot, McuConfig(), 100.0)
        board.open(115200)
        board.armed = True
        queue = list(lines)

        def listen(until_ns: int) -> list[tuple[int, bytes]]:
            VirtualWire.listen(robot, until_ns)
            return [(until_ns, queue.pop(0))]

        robot.listen = listen  # type: ignore[method-assign]
        for _ in lines:
            board.listen(0.02)

    quiet = [still] * 9
    answered(*quiet, wild, *quiet)
    with pytest.raises(StoppedError):
        answered(*quiet, wild, wild, wild)


def test_silence_ends_the_check_only_during_a_drive() -> None:
    robot = Robot("plain_only")
    with robot.board() as board:
        board.listen(5.0)
        board.drive(ZERO, 0.2)
        with robot.mcu.mute(), pytest.raises(StoppedError) as end:
            board.drive((SPEED, 0.0, 0.0, 0.0), 2.0)
    assert end.value.finding.name == "link"
    assert "while it had to turn motor a" in end.value.finding.text
    assert robot.later() == [0.0] * 4


def test_short_drives_without_a_reply_add_up_unless_a_reply_arrives_between_them() -> None:
    robot = Robot("plain_only")
    with robot.board() as board:
        for _ in range(10):
            with robot.mcu.mute():
                board.drive(ZERO, 0.2)
            board.send_zero()
        with robot.mcu.mute():
            for _ in range(2):
                board.drive(ZERO, 0.14)
                board.listen(1.0)
            with pytest.raises(StoppedError) as end:
                board.drive(ZERO, 0.14)
    assert end.value.finding.figure == "silent for 0.3 s"
    assert "while this computer sent it only zeros" in end.value.finding.text
    assert "motor" not in end.value.finding.mend


@pytest.mark.parametrize("sent", [False, True])
def test_the_check_waits_for_wheels_that_slow_down_and_blames_no_comma(sent: bool) -> None:
    config = Config(sim=SimConfig(motor_time_constant=1.5))
    robot = Robot("plain_only", config=config, trailing_comma=sent)
    with robot.board() as board:
        board.drive((0.0, 0.0, 0.0, SPEED), 3.0)
        began_s = board.now_s
        board.stop_motors()
        assert not board.latched
        assert board.comma is sent
        assert MOTOR_TIMEOUT_S < board.now_s - began_s < SLOWING_TIMEOUT_S


def test_the_wait_for_wheels_that_slow_down_has_an_end() -> None:
    config = Config(sim=SimConfig(motor_time_constant=5.0))
    robot = Robot("plain_only", config=config)
    with robot.board() as board:
        board.drive((0.0, 0.0, 0.0, SPEED), 4.0)
        began = robot.now_ns()
        board.stop_motors()  # the second wait succeeds
        assert SLOWING_TIMEOUT_S * 1e9 < robot.now_ns() - began < 2 * SLOWING_TIMEOUT_S * 1e9
        assert not board.latched
        assert not board.comma


def test_the_virtual_wire_is_a_wire_and_the_absent_operator_is_an_operator() -> None:
    wire: Wire = VirtualWire(FakeMcu(Config()))
    operator: Operator = Nobody()
    assert wire.now_ns() == 0
    assert operator.ask("lifted?", ("lifted",)) == "lifted"
    assert operator.ask("which?", ("this", "that")) is None
