"""A board that does not stop, runs away or falls silent ends the check."""

from __future__ import annotations

import pytest

from acsard.checkup.board import Board
from acsard.checkup.findings import StoppedError
from acsard.checkup.motion import MOTOR_TIMEOUT_S, SLOWING_TIMEOUT_S, SPEED, ZERO
from acsard.checkup.watchdog import run
from acsard.checkup.wheels import turn
from acsard.core.config.settings import Config, McuConfig, SimConfig
from acsard.core.simulator import protocol
from acsard.core.simulator.virtual_wire import VirtualWire
from acsard.host.errors import MendableError
from tests.unit.checkup_robots import Robot

ALL = (0, 1, 2, 3)


def test_no_line_is_sent_if_the_serial_line_does_not_open() -> None:
    class Held(Robot):
        def open(self, baud_rate: int) -> None:
            raise MendableError("held")

    robot = Held()
    with pytest.raises(MendableError), Board(robot, McuConfig(), 100.0):
        pass
    assert robot.sent == []


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


def test_motors_that_turn_alone_but_not_together_end_the_check() -> None:
    def gives_in(line: bytes) -> protocol.Command | None:
        command = protocol.reference(line)
        if command and sum(map(bool, command.values.values())) > 1:
            return protocol.Command(dict.fromkeys(command.values, 0.0))
        return command

    robot = Robot("plain_only")
    with robot.board() as board:
        robot.mcu.understand = gives_in
        assert turn(board, 0, 3.0)[0][0] == pytest.approx(3.0, abs=0.1)
        board.stop_motors()
        with pytest.raises(StoppedError) as end:
            run(board, ALL, 0.0)
    assert "not together" in end.value.finding.text
