"""One control step as a recording stores it: all of its inputs, and its outputs.

Poses from odometry are rounded to um and urad. A checksum of the exact values lets a replay detect
differences that are smaller than this rounding. `rows.py` encodes batches of steps.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import msgspec
from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.guard import Guard
from acsard.core.robot import Robot
from acsard.core.values import (
    AcsardError,
    Command,
    Estimate,
    Event,
    Inputs,
    Outputs,
    Recording,
)

MICRO = 1e6

Status = tuple[str, str, str, str]
"""Tuple: mode of the robot, reason of the mode in words, state of the link, and source that
commands the robot ("" if there is none)."""

Micropose = tuple[int, int, int]
"""Pose as integers: x and y in um, yaw in urad."""

_DOUBLES = struct.Struct("<9d")


class Taken(NamedTuple):
    """A finished step that the control loop hands to the recorder."""

    inputs: Inputs
    outputs: Outputs
    sent: bytes | None
    """Line that the daemon wrote to the serial port, or None if it wrote no line."""


class Start(NamedTuple):
    """State of the robot before the step `number`.

    The recorder begins a new file with a `Start`, or writes it as a checkpoint into the present
    file.
    """

    number: int
    state: bytes
    """The robot and its guard, encoded by `state.freeze`; empty for a new robot."""
    config: Config
    """Configuration before step `number`. It includes all changes since the daemon's start."""


def runs(items: list[Taken | Start]) -> Iterator[tuple[Start | None, list[Taken]]]:
    """Split the recorder's queue at each `Start`, and yield a pair for each part.

    The pair is a `Start` and the steps that follow it. The first pair has None instead of a
    `Start`: its steps continue those that were taken from the queue before.
    """
    start: Start | None = None
    steps: list[Taken] = []
    for item in items:
        if isinstance(item, Taken):
            steps.append(item)
            continue
        yield start, steps
        start, steps = item, []
    yield start, steps


class BlackBox(Protocol):
    """Interface of the recorder for the control loop. No method waits for the disk."""

    def begins(self, robot: Robot, guard: Guard) -> None:
        """Record the state of the robot and of its guard before the first step."""

    def step(
        self, inputs: Inputs, outputs: Outputs, sent: bytes | None, robot: Robot, guard: Guard
    ) -> None:
        """Record a finished step.

        `sent` is the line that was written to the serial port, or None. `robot` and `guard` are in
        their state after the step.
        """

    def died(self, inputs: Inputs) -> None:
        """Record the inputs of the step in which the daemon failed, just before the daemon ends."""

    @property
    def status(self) -> Recording:
        """Status of the recording."""


class RecordedOutputs(Struct, frozen=True):
    """The part of a step's outputs that a recording stores."""

    line: bytes | None
    """Line that the robot decided to send, or None."""
    sent: bytes | None
    """Line that was written to the serial port, or None."""
    status: Status
    poses: tuple[Micropose, ...]
    """One pose for each feedback line that odometry accepted."""
    events: tuple[Event, ...] = ()
    checksum: int | None = None
    """CRC-32 of the exact poses, twists and wheel rotations in the whole batch. Only the last
    step of a batch has this checksum; it is None in the other steps."""
    names: int | None = None
    """CRC-32 of all `input_names()` of the batch; None in a file of an older version. Only the last
    step of a batch has this checksum; it is None in the other steps."""


class Step(Struct, frozen=True):
    """A decoded step. `number` counts the steps since the daemon's start."""

    number: int
    inputs: Inputs
    recorded: RecordedOutputs
    begins: bool = False
    """True for the first step of a batch, at which both checksums restart from 0."""


class UnfinishedError(AcsardError):
    """The record of the step in which the daemon failed cannot be decoded.

    The daemon failed before it finished this control step. The record therefore contains the inputs
    of the step, but no outputs (`Unfinished`).
    """


class Unfinished(Struct, frozen=True):
    """Inputs of the control step in which the daemon failed.

    The daemon did not finish this step, so the record contains only the inputs of the step.
    """

    number: int
    inputs: Inputs

    def encode(self) -> bytes:
        """Encode the inputs with field names, because a later version may add fields."""
        return msgspec.msgpack.encode(self)


_unfinished = msgspec.msgpack.Decoder(Unfinished)


def unfinished(data: bytes) -> Unfinished:
    """Decode the record of the control step in which the daemon failed.

    Raises `UnfinishedError` if the bytes are damaged.
    """
    try:
        return _unfinished.decode(data)
    except msgspec.MsgspecError as error:
        raise UnfinishedError(
            f"the step in which the daemon failed cannot be read: {error}"
        ) from None


def checksum(estimates: Sequence[Estimate], before: int) -> int:
    """Extend the CRC-32 `before` by the estimates of a step, and return the new CRC-32.

    The CRC-32 covers all bits of the poses, the twists and the angles by which the wheels turned.
    `before` is 0 for the first step of a batch.
    """
    for e in estimates:
        pose, twist = e.pose, e.twist
        data = _DOUBLES.pack(pose.x, pose.y, pose.yaw, twist.linear, twist.angular, *e.positions)
        before = zlib.crc32(data, before)
    return before


def input_names(inputs: Inputs, before: int) -> int:
    """Extend the CRC-32 `before` by the names in the inputs of a step, and return the new CRC-32.

    The names are those of sources, senders and clients. `before` is 0 for the first step of a
    batch.
    """
    names = [
        *[name for command in inputs.commands for name in (command.source, command.sender)],
        *[request.by for request in inputs.requests],
        *[name for refusal in inputs.refusals for name in (refusal.source, refusal.sender)],
        *[event.by for event in inputs.events],
    ]
    # Most steps contain no names. The JSON encoding shows where each name ends.
    return zlib.crc32(msgspec.json.encode(names), before) if names else before


def count_superseded(commands: Sequence[Command]) -> int:
    """Return how many commands of a step are followed by a newer command of the same sender."""
    return len(commands) - len({(command.source, command.sender) for command in commands})


def status_of(outputs: Outputs) -> Status:
    return outputs.mode, outputs.reason, outputs.link, outputs.source


def micropose(estimate: Estimate) -> Micropose:
    pose = estimate.pose
    return round(pose.x * MICRO), round(pose.y * MICRO), round(pose.yaw * MICRO)
