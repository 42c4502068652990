"""A tested motor runs at speed for a moment and stands still afterwards."""

from __future__ import annotations

import pytest

from acsard.checkup import dialect, turning
from acsard.checkup.limits import GLANCE_S, PATIENCE_S, SPEED
from acsard.checkup.wheels import Channel
from acsard.config.settings import Config, SimConfig
from tests.unit.checkup.robots import Robot


@pytest.mark.parametrize("motor", range(4))
def test_one_motor_turns_and_no_other(motor: int) -> None:
    robot = Robot("plain_only")
    with robot.board() as board:
        means, _ = turning.turn(board, motor, -SPEED)
        assert means[motor] == pytest.approx(-SPEED, abs=0.1)
        assert [m for m in range(4) if means[m]] == [motor]


def test_the_speed_is_ramped() -> None:
    robot = Robot("plain_only")
    with robot.board() as board:
        before = len(robot.sent)
        turning.run_up(board, turning.one(0, SPEED))
        told = [float(line[2:7]) for line in robot.sent[before:]]
    assert told[:9] == sorted(told[:9])
    assert told[0] <= SPEED / 5
    assert max(told) == SPEED


def test_a_motor_that_shows_nothing_is_not_held_for_long() -> None:
    robot = Robot("plain_only", "stuck_encoder=1".replace("1", "b"))
    with robot.board() as board:
        began = robot.now_ns()
        turning.run_up(board, turning.one(1, SPEED))
        assert robot.now_ns() - began < 1e9


def test_every_motor_that_turns_as_told_is_right() -> None:
    with Robot("plain_only").board() as board:
        found = [turning.channel(board, motor) for motor in range(4)]
        comma = dialect.comma(board, found[-1].kind == "dead")
    assert [channel.kind for channel in found] == ["right"] * 4
    assert (comma.verdict, comma.figure) == ("PASS", "not needed")


def test_a_probe_is_short_and_slow_and_no_dead_motor_is_told_more() -> None:
    robot = Robot("plain_only", "dead_motor=b")
    with robot.board() as board:
        began, before = robot.now_ns(), len(robot.sent)
        assert turning.probe(board, 1) == (0.0, 0.0, 0.0, 0.0)
        told = [line for line in robot.sent[before:] if b"bp00.00" not in line]
        assert {line[8:15] for line in told} == {b"bp01.50", b"bp03.00"}
        assert len(told) <= 2 * (GLANCE_S / board.period_s + 1)
        assert robot.now_ns() - began < 3e9
        assert turning.probe(board, 0) is None


@pytest.mark.parametrize("per_turn", [16, 24, 48, 3200])
@pytest.mark.parametrize("lag", [0.0, 0.3, 1.0])
def test_a_probe_finds_what_follows_and_what_is_reversed(per_turn: int, lag: float) -> None:
    config = Config(sim=SimConfig(motor_time_constant=lag, encoder_counts=per_turn))
    for fault, follows in ((), True), (("reversed_encoder=c",), False):
        robot = Robot("plain_only", *fault, config=config)
        with robot.board() as board:
            seen = turning.probe(board, 2)
            assert (seen is None) is follows
            if seen is not None:
                channel = Channel(2, seen, (0.0, 0.0, 0.0, 0.0), probed=True)
                assert channel.kind == "reversed"


def test_a_motor_that_still_speeds_up_is_held_on_but_not_for_ever() -> None:
    for lag, speed in ((1.0, 2.7), (2.0, 2.0)):
        robot = Robot("plain_only", config=Config(sim=SimConfig(motor_time_constant=lag)))
        with robot.board() as board:
            began = robot.now_ns()
            assert turning.run_up(board, turning.one(0, SPEED))[0] > speed
            assert robot.now_ns() - began < 1.2e9 * PATIENCE_S
