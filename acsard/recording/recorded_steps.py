"""One step of the control loop: as the loop hands it over, and as a recording stores it.

A step is what the robot heard, whether it then made a line, and what left. Its outputs are stored
for comparison, with poses rounded to um and urad. A checksum of the exact values shows smaller
differences.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import NamedTuple, Protocol

from msgspec import Struct

from acsard.core.guard import Guard
from acsard.core.robot import Robot
from acsard.core.values import (
    Estimate,
    Event,
    Heard,
    Instant,
    News,
    Ns,
    Recording,
    Status,
    Trip,
)

US_PER_S = 1e6

Micropose = tuple[int, int, int]  # x and y in um, yaw in urad

_DOUBLES = struct.Struct("<9d")


class FinishedStep(NamedTuple):
    """A step of the control loop."""

    now: Instant
    heard: Heard
    driven: bool  # `Robot.drive` was called
    line: bytes | None  # its result
    sent: bytes | None  # on the serial port
    trip: Trip  # why the guard replaced `line`
    late_ns: Ns  # from `now` until `sent` left, as `Robot.sent` was told
    news: News
    status: Status


# A `FinishedStep` without its class, which the control loop makes in a third of the time.
PlainStep = tuple[Instant, Heard, bool, bytes | None, bytes | None, Trip, Ns, News, Status]


class StepRecorder(Protocol):
    """Interface through which the control loop uses the recorder. No method waits for the disk."""

    def begins(self, robot: Robot, guard: Guard) -> None:
        """Record the state before the first step."""

    def step(self, step: PlainStep, robot: Robot, guard: Guard) -> None:
        """Record a finished step, and perhaps the state after it."""

    def died(self, now: Instant, heard: Heard) -> None:
        """Record, once, what was heard in the step in which the daemon failed."""

    @property
    def status(self) -> Recording:
        """Directory of the recordings, present problem, and number of steps not recorded."""


class RecordedOutputs(Struct, frozen=True):
    line: bytes | None  # that the robot decided to send
    sent: bytes | None  # on the serial port
    status: Status
    poses: tuple[Micropose, ...]  # for each line that odometry accepted
    events: tuple[Event, ...] = ()
    # Of the estimates of all steps of a record, in its last step
    checksum: int | None = None


class RecordedStep(Struct, frozen=True):
    number: int  # from 0 at the daemon's start
    now: Instant
    heard: Heard
    driven: bool
    trip: Trip
    late_ns: Ns
    recorded: RecordedOutputs
    begins: bool = False  # first of a record: the checksum restarts at 0


def checksum(estimates: Sequence[Estimate], before: int) -> int:
    """Return the CRC-32 of all bits of a record's poses, twists and angles, up to this step."""
    for e in estimates:
        pose, twist = e.pose, e.twist
        data = _DOUBLES.pack(pose.x, pose.y, pose.yaw, twist.linear, twist.angular, *e.positions)
        before = zlib.crc32(data, before)
    return before


def micropose(estimate: Estimate) -> Micropose:
    pose = estimate.pose
    return round(pose.x * US_PER_S), round(pose.y * US_PER_S), round(pose.yaw * US_PER_S)
