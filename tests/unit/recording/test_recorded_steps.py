"""A recording stores rounded estimates, and a checksum of the exact estimates."""

from __future__ import annotations

from msgspec.structs import replace

from acsard.core.values import Estimate, Pose
from acsard.recording.recorded_steps import checksum, micropose
from tests.scenarios.taped import Tape
from tests.scenarios.world import World


def estimates() -> list[Estimate]:
    tape = Tape()
    World(recorder=tape).drive(0.5, 0.2, seconds=0.5)
    return [estimate for step in tape.taken for estimate in step.news.estimates]


def test_poses_are_rounded_to_millionths() -> None:
    (first, *_) = estimates()
    turned = replace(first, pose=Pose(1.0000004, -2.0000006, 3.1415926))
    assert micropose(turned) == (1_000_000, -2_000_001, 3_141_593)


def test_a_checksum_continues_and_covers_every_bit() -> None:
    every = estimates()
    assert checksum(every[5:], checksum(every[:5], 0)) == checksum(every, 0)
    last = every[-1]
    nudged = replace(last, pose=replace(last.pose, x=last.pose.x + 1e-16 + last.pose.x * 2e-16))
    assert checksum([*every[:-1], nudged], 0) != checksum(every, 0)
    turned = replace(last, positions=(0.0, *last.positions[1:]))
    assert checksum([*every[:-1], turned], 0) != checksum(every, 0)
