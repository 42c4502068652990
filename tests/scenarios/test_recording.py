"""A replay of a recording gives identical bytes, and detects any changed byte."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from acsard.core.config.named_faults import FAULTS
from acsard.core.config.settings import Config
from acsard.core.link.serial_output import Offered
from acsard.core.robot import Robot
from acsard.core.values import Instant
from acsard.recording.replay import Replay
from tests.scenarios.taped import (
    INPUTS,
    WITH_ARGUMENTS,
    Tape,
    drive_through_faults,
    recorded_world,
    replayed,
)
from tests.scenarios.world import World

PLAIN = Config()
FULL = replace(
    PLAIN,
    mcu=replace(PLAIN.mcu, link_check="on", encoder_counts=3200),
    odometry=replace(PLAIN.odometry, gyro=True),
)
SLOW_LIMITS = replace(PLAIN, limits=replace(PLAIN.limits, linear_speed=0.3))


def taped(config: Config, seconds: float) -> Tape:
    tape, world = recorded_world(config)
    drive_through_faults(world, seconds)
    return tape


def lives_again(tape: Tape, config: Config, first: int = 0, least: int = 100) -> None:
    comparison = replayed(tape, config, first).comparison
    assert comparison.first is None
    assert comparison.exact
    assert comparison.steps == comparison.modes_same == len(tape.taken) - first
    steps = tape.taken[first:]
    lines = sum(step.line is not None for step in steps)
    assert comparison.lines == comparison.lines_same == lines >= least
    poses = sum(len(step.news.estimates) for step in steps)
    assert comparison.poses == comparison.poses_same == poses >= least
    assert comparison.end is not None
    assert comparison.end[0] == comparison.end[1]
    assert comparison.max_distance_m == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        pytest.param(PLAIN, id="plain", marks=pytest.mark.slow),
        pytest.param(FULL, id="checked, counted, with a gyro"),
    ],
)
def test_a_drive_through_every_fault_is_replayed_to_the_last_bit(config: Config) -> None:
    tape, world = recorded_world(config)
    # `test_emergency_stop.py` and `test_bumpers.py` replay the inputs.
    assert {*drive_through_faults(world, 45.0)} == {*FAULTS, *WITH_ARGUMENTS} - INPUTS
    for has in ("missed", "refusals", "requests", "port_trouble", "commands"):
        assert any(getattr(step.heard, has) for step in tape.taken), has
    assert any(step.line is not None and step.sent is None for step in tape.taken)
    lives_again(tape, config)


def test_a_replay_counts_lines_and_commands_as_the_daemon_did() -> None:
    tape, world = recorded_world(PLAIN)
    world.drive(0.3, seconds=0.5)
    world.send_together([0.2, 0.3])
    world.port.blocked = True
    world.run(0.05)
    world.port.blocked = False
    world.run(0.2)
    offer = world.port.offer

    def unplug(line: bytes, now: Instant) -> Offered:
        world.port.unplug()
        return offer(line, now)

    world.port.offer = unplug  # type: ignore[method-assign]
    world.run(0.1)
    counters = world.loop.robot.counters
    assert counters["lines_sent"] > 50
    # Five periods, one command between two of them, and the line in which the port was lost.
    assert counters["lines_superseded"] == 7
    assert counters["commands_superseded"] == 1
    assert replayed(tape, PLAIN).robot.counters == counters


def test_a_line_that_differs_is_reported_with_the_inputs_of_both_sides() -> None:
    tape = Tape()
    World(recorder=tape).drive(0.5, 0.2, seconds=1.0)
    number = len(tape.taken) - 3
    while tape.taken[number].line is None:
        number -= 1
    step = tape.taken[number]
    other = step._replace(line=b"ap01.00,bp01.00,cp01.00,dp01.00\r\n")
    tape.taken[number] = other
    first = replayed(tape, PLAIN).comparison.first
    assert first is not None
    assert (first.number, first.what) == (number, ("line",))
    assert (first.recorded.line, first.replayed.line) == (other.line, step.line)


def test_a_pose_that_differs_in_one_bit_is_the_same_but_not_exact() -> None:
    tape = Tape()
    World(recorder=tape).drive(0.5, 0.2, seconds=1.0)
    number = max(n for n, t in enumerate(tape.taken) if t.news.estimates)
    step = tape.taken[number]
    (estimate,) = step.news.estimates
    nudged = replace(estimate, pose=replace(estimate.pose, x=estimate.pose.x + 1e-15))
    tape.taken[number] = step._replace(news=replace(step.news, estimates=(nudged,)))
    comparison = replayed(tape, PLAIN).comparison
    assert (comparison.same, comparison.exact) == (True, False)


def test_a_replay_with_other_limits_reports_the_first_line_that_differs() -> None:
    tape = Tape()
    World(recorder=tape).drive(0.5, seconds=2.0)
    replay = Replay(Robot(SLOW_LIMITS))
    for step in tape.steps():
        replay.step(step)
    comparison = replay.comparison
    first = comparison.first
    assert first is not None
    assert first.what == ("line", "sent line")
    assert first.recorded.status.mode == first.replayed.status.mode == "driving"
    assert comparison.max_wheel_speeds == (1000, 600)  # 0.5 and 0.3 m/s on wheels of 0.05 m
