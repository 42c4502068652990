"""One control step as a recording stores it: all inputs, and the outputs that are worth comparing.

Poses are rounded to um and urad, and a checksum of the exact values shows smaller differences.
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
    Inputs,
    Outputs,
    Recording,
)

US_PER_S = 1e6

Status = tuple[str, str, str, str, str]  # mode, its reason, link, source that commands, code

Micropose = tuple[int, int, int]  # x and y in um, yaw in urad

_DOUBLES = struct.Struct("<9d")


class FinishedStep(NamedTuple):
    inputs: Inputs
    outputs: Outputs
    sent: bytes | None  # line on the serial port


class StepRecorder(Protocol):
    """Interface through which the control loop uses the recorder. No method waits for the disk."""

    def begins(self, robot: Robot, guard: Guard) -> None:
        """Record the state before the first step."""

    def step(
        self, inputs: Inputs, outputs: Outputs, sent: bytes | None, robot: Robot, guard: Guard
    ) -> None:
        """Record a finished step, with the line on the serial port and the state after it."""

    def died(self, inputs: Inputs) -> None:
        """Record, once, the inputs of the step in which the daemon failed."""

    @property
    def status(self) -> Recording:
        """Directory of the recordings, present problem, and number of steps not recorded."""


class RecordedOutputs(Struct, frozen=True):
    line: bytes | None  # that the robot decided to send
    sent: bytes | None  # on the serial port
    status: Status
    poses: tuple[Micropose, ...]  # for each line that odometry accepted
    events: tuple[Event, ...] = ()
    checksum: int | None = None  # of the estimates of a record's steps, in the last of them


class RecordedStep(Struct, frozen=True):
    number: int  # from 0 at the daemon's start
    inputs: Inputs
    recorded: RecordedOutputs
    begins: bool = False  # first of a record: the checksum restarts at 0


def checksum(estimates: Sequence[Estimate], before: int) -> int:
    """Return the CRC-32 of all bits of a record's poses, twists and angles, up to this step."""
    for e in estimates:
        pose, twist = e.pose, e.twist
        data = _DOUBLES.pack(pose.x, pose.y, pose.yaw, twist.linear, twist.angular, *e.positions)
        before = zlib.crc32(data, before)
    return before


def status_of(outputs: Outputs) -> Status:
    return outputs.mode, outputs.reason, outputs.link, outputs.source, outputs.code


def micropose(estimate: Estimate) -> Micropose:
    pose = estimate.pose
    return round(pose.x * US_PER_S), round(pose.y * US_PER_S), round(pose.yaw * US_PER_S)
