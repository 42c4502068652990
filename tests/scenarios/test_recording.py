"""A replay gives identical bytes, detects any changed byte, and goes on after damage."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, McuConfig, RecordConfig
from acsard.core.link.serial_output import Offered
from acsard.core.robot import Robot
from acsard.core.values import Instant
from acsard.recording import recorder as module
from acsard.recording.file import Head, Recording, listed
from acsard.recording.recorder import Recorder
from acsard.recording.replay import Playback, Replay
from tests.scenarios.taped import (
    BATCH,
    WITH_ARGUMENTS,
    Tape,
    drive_through_faults,
    recorded_world,
    replayed,
)
from tests.scenarios.world import World
from tests.wheels import TWO

PLAIN = Config()
SLOW_LIMITS = replace(PLAIN, limits=replace(PLAIN.limits, linear_speed=0.3))


def test_a_replay_counts_lines_and_commands_as_the_daemon_did() -> None:
    tape, world = recorded_world(PLAIN)
    world.drive(0.3, seconds=0.5)
    world.send_together([0.3, 0.2])
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
    counters = world.loop.robot.state.counters
    assert counters["lines_sent"] > 50
    # Five periods, one command between two of them, and the line in which the port was lost.
    assert counters["lines_superseded"] == 7
    assert counters["commands_superseded"] == 1
    assert replayed(tape, PLAIN).robot.state.counters == counters


@pytest.mark.slow
def test_a_drive_of_two_wheels_replays_to_the_bit_from_its_start_and_its_states() -> None:
    config = replace(PLAIN, mcu=McuConfig(wheels=TWO))
    tape, world = recorded_world(config, every=5 * BATCH)
    world.run(0.5)
    faults = drive_through_faults(world, 13.0, cases=WITH_ARGUMENTS)
    assert {"dead_motor", "swapped_wheels"} <= {*faults}
    world.drive(0.4, 0.3, seconds=1.0)
    for fault in ("dead_motor", "reversed_encoder"):
        with world.mcu.fault(fault, 0):
            world.hold(0.4, 0.3, seconds=2.0)
    assert {"wheel_fault", "fault"} <= {event.name for event in world.events}
    for first in (0, *tape.states):
        comparison = replayed(tape, config, first).comparison
        assert comparison.exact, first
        assert comparison.all["lines"] == comparison.equal["lines"]


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


# A replay goes on after damage in a recording, and says which steps it has not compared


SECONDS = 100

FRAME_S = 20
"""Longest part of a drive that damage at one place costs, but for the half second beside it."""

DAMAGED_BYTES = (1, 16, 512, 4096)
"""Sizes of the damaged places: among them a sector and a page."""


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording by the real recorder of a drive in virtual time, with changes of a setting."""
    dice, where = random.Random(1), tmp_path_factory.mktemp("record")
    # With the default rate the recording and each replay would take 4 s each.
    config = replace(
        Config(),
        control=replace(Config().control, rate=10.0),
        record=RecordConfig(str(where), 1000.0),
    )
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(module, "WRITE_PAUSE_S", 1000.0)
        patched.setattr(module, "CLOSE_S", 20.0)
        recorder = Recorder(config, lambda event: None)
        world = World(config, recorder=recorder)
        world.drive(0.5, 0.2, seconds=1.0)
        for second in range(SECONDS):
            if second % 25 == 12:
                settings = b'{"settings": {"limits.linear_speed": %.1f}}' % dice.uniform(0.5, 0.9)
                assert world.call("set", settings).success
            speed = 0.0 if second % 30 < 5 else dice.uniform(-0.8, 0.8)
            world.hold(speed, dice.uniform(-1.0, 1.0), seconds=1.0)
            recorder._writer.write(recorder._take_queue(), False)
        recorder.close()
    (path,) = listed(where)
    return path


def played(path: Path, other: Config | None = None) -> tuple[list[int], Playback, Recording]:
    recording = Recording([path])
    playback = Playback(recording, other)
    return [step.number for step, _ in playback.steps()], playback, recording


@pytest.fixture(scope="module")
def whole(long: Path) -> list[int]:
    """The numbers of all steps."""
    numbers, playback, recording = played(long)
    assert (playback.comparison.same, playback.comparison.exact) == (True, True)
    assert (playback.gaps, recording.damage) == ([], [])
    heads = [record for record in recording.records() if isinstance(record, Head)]
    assert len(heads) >= SECONDS // FRAME_S
    assert len({head.config for head in heads}) > 3
    return numbers


FRAME_BEGINS = bytes.fromhex("28b52ffd")


def judge(path: Path, whole: list[int], frames: int = 1) -> None:
    """Replay a damaged copy of the recording, of which so many frames are damaged."""
    numbers, playback, recording = played(path)
    assert playback.comparison.same, playback.comparison.first
    assert playback.comparison.exact
    assert len(recording.damage) <= 1
    lost = sorted(set(whole) - set(numbers))
    assert recording.damage or not lost
    # A gap is between steps; the first or the last frame may be missing, too.
    between = [number for number in lost if numbers[0] < number < numbers[-1]]
    assert sum(gap.steps for gap in playback.gaps) == len(between)
    assert len(lost) <= frames * len(whole) * (FRAME_S + 1.0) / SECONDS * 1.2


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_damage_costs_one_frame(seed: int, long: Path, whole: list[int], tmp_path: Path) -> None:
    dice, data = random.Random(seed), bytearray(long.read_bytes())
    at, size = dice.randrange(len(data)), DAMAGED_BYTES[seed]
    frames = 1 + data[at : at + size].count(FRAME_BEGINS)
    for place in range(at, min(at + size, len(data))):
        data[place] ^= 0xA5
    path = tmp_path / "damaged"
    path.write_bytes(data)
    judge(path, whole, frames)


def test_another_configuration_stays_in_force_after_damage(
    long: Path, whole: list[int], tmp_path: Path
) -> None:
    data = bytearray(long.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 16] = bytes(16)
    path = tmp_path / "damaged"
    path.write_bytes(data)
    other = replace(Config(), limits=replace(Config().limits, angular_speed=0.3))
    recording = Recording([path])
    playback = Playback(recording, other)
    limits = {playback.robot.config.limits.angular_speed for _ in playback.steps()}
    assert limits == {0.3}
    assert len(playback.gaps) == 1
