"""A board that does not stop, runs away or falls silent ends the check."""

from __future__ import annotations

import pytest

from acsard.checkup.findings import StoppedError, motor_name
from acsard.checkup.motion import MOTOR_TIMEOUT_S
from acsard.checkup.motor_channels import turn
from acsard.checkup.watchdog import run
from acsard.core.config.settings import Config
from acsard.core.simulator import protocol
from tests.unit.checkup_robots import FOUR_AND_TWO, Robot

pytestmark = FOUR_AND_TWO


def test_a_motor_that_zeros_do_not_stop_ends_the_check(config: Config) -> None:
    class Deaf(Robot):
        def send(self, data: bytes) -> None:
            super().send(data)
            if max(self.mcu.vehicle.speeds) > 2.0:
                vars(self.mcu)["understand"] = lambda line: None

    robot = Deaf("no_watchdog", "free_running", config=config)
    with robot.board() as board:
        board.drive(board.only([0]), 0.3)
        with pytest.raises(StoppedError) as end:
            board.stop_motors()
        sent = len(robot.sent)
    assert end.value.finding.name == "stop"
    assert f"{2 * MOTOR_TIMEOUT_S:g} s" in end.value.finding.figure
    assert motor_name(config.mcu, 0) in end.value.finding.text
    assert robot.sent[-1].startswith(b"\r\n")  # one line, then silence
    assert not robot.sent[-2].startswith(b"\r\n")
    assert len(robot.sent) == sent


def test_silence_ends_the_check_only_during_a_drive(config: Config) -> None:
    robot = Robot("plain_only", config=config)
    with robot.board() as board:
        board.listen(5.0)
        board.drive(board.zero, 0.2)
        with robot.mcu.fault("mute"), pytest.raises(StoppedError) as end:
            board.drive(board.only([0]), 2.0)
    assert end.value.finding.name == "link"
    assert f"while it had to turn {motor_name(config.mcu, 0)}" in end.value.finding.text
    assert robot.later() == [0.0] * 4


def test_motors_that_turn_alone_but_not_together_end_the_check(config: Config) -> None:
    def gives_in(line: bytes) -> protocol.BoardCommand | None:
        command = protocol.reference(line, robot.mcu.letters)
        if command and sum(map(bool, command.values.values())) > 1:
            return protocol.BoardCommand(dict.fromkeys(command.values, 0.0))
        return command

    robot = Robot("plain_only", config=config)
    with robot.board() as board:
        vars(robot.mcu)["understand"] = gives_in
        assert turn(board, 0, 3.0)[0][0] == pytest.approx(3.0, abs=0.1)
        board.stop_motors()
        with pytest.raises(StoppedError) as end:
            run(board, range(len(board.letters)), 0.0)
    assert "not together" in end.value.finding.text
