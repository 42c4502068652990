"""Tests of each way to measure the watchdog's time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from acsard.checkup import dialect, watchdog
from acsard.checkup.board import Board
from acsard.checkup.findings import StoppedError
from acsard.checkup.motion import SPEED
from acsard.checkup.watchdog import NOT_MEASURED, Bounds, run
from acsard.checkup.wheels import turn
from acsard.core.config.settings import Config, SimConfig
from acsard.core.simulator import protocol
from tests.unit.checkup.robots import Robot

ALL = (0, 1, 2, 3)


class ByItsOwnClock(Robot):
    """A robot whose firmware measures each speed over one of its own fixed control periods."""

    def __init__(self, *faults: str, config: Config | None = None) -> None:
        super().__init__(*faults, config=config)
        self.mcu._speeds = lambda now_ns: list(self.mcu.vehicle.speeds)  # type: ignore[method-assign]


@contextmanager
def turned(robot: Robot) -> Iterator[Board]:
    """Run the steps before the watchdog test, and yield the board with motors at rest."""
    with robot.board() as board:
        dialect.rate(board)
        dialect.check(board)
        for motor in ALL:
            turn(board, motor, 3.0)
            board.stop_motors()
        yield board
        assert board.turning() == []


def measured(robot: Robot) -> tuple[str, str]:
    with turned(robot) as board:
        finding = watchdog.finding(board, ALL)
    assert robot.later() == [0.0] * 4
    return finding.verdict, finding.figure


@pytest.mark.variations(3)
@pytest.mark.parametrize("kind", [("plain_only",), ("no_sample",), (), ("free_running",)])
@pytest.mark.parametrize("time_ms", [120, 450])
@pytest.mark.parametrize("robot", [Robot, ByItsOwnClock])
def test_a_watchdog_time_within_the_contract_is_measured_and_passes(
    kind: tuple[str, ...], time_ms: int, robot: type[Robot]
) -> None:
    instance = robot(*kind)
    instance.mcu.watchdog_ns = time_ms * 1_000_000
    verdict, figure = measured(instance)
    value, _, about = figure.partition(" ms")
    assert int(value) == pytest.approx(time_ms, abs=60 if about else 20)
    assert verdict == "PASS"


@pytest.mark.variations(3)
@pytest.mark.parametrize("kind", [("plain_only",), (), ("free_running",)])
@pytest.mark.parametrize("lag", [0.0, 0.05, 0.3])
def test_the_run_out_of_a_motor_is_not_taken_for_the_watchdog(
    kind: tuple[str, ...], lag: float
) -> None:
    config = Config(sim=SimConfig(motor_time_constant=lag))
    for robot in (Robot, ByItsOwnClock):
        verdict, figure = measured(robot(*kind, config=config))
        assert int(figure.split()[0]) == pytest.approx(300, abs=80)
        assert verdict == "PASS"


@pytest.mark.parametrize("kind", ["plain_only", "no_sample", "free_running"])
def test_a_missing_watchdog_and_a_late_watchdog_fail(kind: str) -> None:
    for robot in (Robot, ByItsOwnClock):
        assert measured(robot(kind, "no_watchdog")) == ("FAIL", "none within 2.5 s")
        verdict, figure = measured(robot(kind, "late_watchdog"))
        assert verdict == "FAIL"
        assert int(figure.split()[0]) == pytest.approx(1000, abs=100)


def test_a_watchdog_too_short_for_any_host_is_a_warning() -> None:
    robot = Robot()
    robot.mcu.watchdog_ns = 40_000_000
    assert measured(robot)[0] == "WARN"


def test_without_a_motor_that_turns_as_commanded_the_watchdog_is_skipped() -> None:
    with Robot().board() as board:
        assert watchdog.finding(board, []).verdict == "SKIPPED"


@pytest.mark.variations(4)
@pytest.mark.parametrize("kind", [("plain_only",), ("no_sample",), (), ("free_running",)])
@pytest.mark.parametrize("lag", [0.0, pytest.param(0.6, marks=pytest.mark.slow)])
def test_only_a_watchdog_that_broken_lines_feed_fails(kind: tuple[str, ...], lag: float) -> None:
    config = Config(sim=SimConfig(motor_time_constant=lag))
    for robot in (Robot,) if lag else (Robot, ByItsOwnClock):
        assert measured(robot(*kind, config=config))[0] == "PASS"
        verdict, figure = measured(robot(*kind, "watchdog_fed_by_bad_lines", config=config))
        assert verdict == "FAIL"
        assert figure.endswith("damaged lines keep it from acting")


def test_firmware_that_obeys_broken_lines_never_gets_more_than_the_commanded_speed() -> None:
    robot = Robot("comma_latched", trailing_comma=True)
    with robot.board() as board:
        assert watchdog.finding(board, ALL).figure.endswith("damaged lines keep it from acting")
    commands = [protocol.latched(line).values.values() for _, line in robot.mcu.heard]
    assert max(abs(value) for values in commands for value in values) == SPEED


@pytest.mark.slow
@pytest.mark.parametrize("fault", [(), ("no_check",)])
@pytest.mark.parametrize("per_turn", [16, 24, 48, 96])
@pytest.mark.parametrize("time_s", [0.3, 0.52])
def test_a_time_measured_too_coarsely_to_judge_does_not_pass(
    fault: tuple[str, ...], per_turn: int, time_s: float
) -> None:
    robot = Robot(*fault, config=Config(sim=SimConfig(encoder_counts=per_turn)))
    robot.mcu.watchdog_ns = int(time_s * 1e9)
    verdict, figure = measured(robot)
    middle, _, about = figure.removesuffix(" ms").partition(" ms ± ")
    assert int(middle) == pytest.approx(1000 * time_s, abs=int(about) + 15)
    reaches = int(middle) + int(about) > 500
    if verdict == "PASS":
        assert time_s == 0.3
        assert not reaches
    else:
        assert reaches
        assert time_s != 0.3 or verdict == "WARN"


# the measured time alone, before it is judged

SLACK_S = 0.02
"""Delay of a reply, which the interval does not include."""


def silence(robot: Robot) -> Bounds:
    with turned(robot) as board:
        return watchdog.measured(board, ALL, run(board, ALL, 0.0))


@pytest.mark.parametrize("kind", [("plain_only",), (), ("free_running",)])
@pytest.mark.parametrize("time_s", [0.2, 0.37])
def test_the_true_time_lies_within_the_measured_interval(
    kind: tuple[str, ...], time_s: float
) -> None:
    robot = Robot(*kind)
    robot.mcu.watchdog_ns = int(time_s * 1e9)
    least_s, most_s = silence(robot)
    assert least_s - SLACK_S <= time_s <= most_s + SLACK_S
    assert most_s - least_s < 0.2


@pytest.mark.parametrize("kind", ["plain_only", "no_sample", "free_running"])
def test_the_watchdog_time_of_motors_that_never_stop_is_unknown(kind: str) -> None:
    assert silence(Robot(kind, "no_watchdog"))[1] == NOT_MEASURED


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
