"""One control step as a recording stores it: all inputs, and the outputs that are worth comparing.

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
from acsard.host.errors import MSGSPEC_ERRORS

US_PER_S = 1e6

Status = tuple[str, str, str, str]
"""Tuple: the robot's mode, the reason of this mode in words, the state of the link to the board,
and the name of the source that commands the robot ("" without a source)."""

Micropose = tuple[int, int, int]
"""Pose as integers: x and y in um, yaw in urad."""

_DOUBLES = struct.Struct("<9d")


class FinishedStep(NamedTuple):
    """A finished step, as the control loop passes it to the recorder."""

    inputs: Inputs
    outputs: Outputs
    sent: bytes | None
    """Line that the daemon wrote to the serial port, or None if it wrote no line."""


class StateBeforeStep(NamedTuple):
    """The robot's state before the step `number`, as the control loop passes it to the recorder.

    The recorder begins a new file with this state, or adds the state to the present file as a
    checkpoint.
    """

    number: int
    state: bytes
    """The state of the robot and of its guard, encoded by `state.freeze`; empty for a new robot."""
    config: Config
    """Configuration before the step `number`, with all changes since the daemon's start."""


def split_at_states(
    items: list[FinishedStep | StateBeforeStep],
) -> Iterator[tuple[StateBeforeStep | None, list[FinishedStep]]]:
    """Split the items of the recorder's queue at each `StateBeforeStep`.

    Yields pairs of a `StateBeforeStep` and the list of the steps that follow it. The first pair
    contains None, and the steps before the first `StateBeforeStep`. These steps continue the steps
    that were taken from the queue earlier.
    """
    start: StateBeforeStep | None = None
    steps: list[FinishedStep] = []
    for item in items:
        if isinstance(item, FinishedStep):
            steps.append(item)
            continue
        yield start, steps
        start, steps = item, []
    yield start, steps


class StepRecorder(Protocol):
    """Interface through which the control loop uses the recorder. No method waits for the disk."""

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
        """Record the inputs of the step in which the daemon failed.

        Call this method once, after the failure and before the daemon ends.
        """

    @property
    def status(self) -> Recording:
        """Directory of the recordings, present problem, and number of steps not recorded."""


class RecordedOutputs(Struct, frozen=True):
    """The part of a step's outputs that a recording stores."""

    line: bytes | None
    """Line to the board that the robot decided to send, or None."""
    sent: bytes | None
    """Line that the daemon wrote to the serial port, or None."""
    status: Status
    poses: tuple[Micropose, ...]
    """One pose for each feedback line of the board that odometry accepted in this step."""
    events: tuple[Event, ...] = ()
    checksum: int | None = None
    """CRC-32 of the exact poses, twists and wheel angles of all steps in a batch (see the function
    `checksum`). Only the last step of a batch has this value. It is None in all other steps."""
    names: int | None = None
    """CRC-32 of the names in the inputs of all steps in a batch (see the function `input_names`).
    Only the last step of a batch has this value. It is None in all other steps, and in files of
    older versions."""


class RecordedStep(Struct, frozen=True):
    """A step that was read from a recording."""

    number: int
    """Number of the step. It counts the steps since the daemon's start, from 0."""
    inputs: Inputs
    recorded: RecordedOutputs
    begins: bool = False
    """True for the first step of a batch. The checksums of the exact values and of the names
    restart from 0 at this step."""

    @property
    def places(self) -> bool:
        """Whether a request sets the pose. It takes effect after the poses of this step."""
        verbs = [request.verb for request in self.inputs.requests]
        return "set_pose" in verbs or "reset_odometry" in verbs


class UnfinishedError(AcsardError):
    """The recorded inputs of the step in which the daemon failed cannot be decoded.

    A recording stores these inputs in a message of its own, on the channel `unfinished`, because
    the daemon did not finish this control step.
    """


class Unfinished(Struct, frozen=True):
    """Inputs of the control step in which the daemon failed.

    The outputs are missing, because the daemon did not finish this step.
    """

    number: int
    """Number of the step. It counts the steps since the daemon's start, from 0."""
    inputs: Inputs

    def encode(self) -> bytes:
        """Return the content of a message on the channel `unfinished`, in MessagePack."""
        # The encoding contains the field names, because a later version may add fields.
        return msgspec.msgpack.encode(self)


_unfinished = msgspec.msgpack.Decoder(Unfinished)


def unfinished(data: bytes) -> Unfinished:
    """Decode a message of the channel `unfinished`: the step in which the daemon failed.

    Raises `UnfinishedError` if the bytes are damaged.
    """
    try:
        return _unfinished.decode(data)
    except MSGSPEC_ERRORS as error:
        raise UnfinishedError(
            f"the step in which the daemon failed cannot be read: {error}"
        ) from None


def checksum(estimates: Sequence[Estimate], before: int) -> int:
    """Return the CRC-32 of the estimates in a batch of steps, up to and including this step.

    It covers all bits of the poses, of the twists and of the angles by which the wheels turned.

    Args:
        estimates: the estimates of this step.
        before: the CRC-32 of the earlier steps of the batch; 0 for the first step.
    """
    for e in estimates:
        pose, twist = e.pose, e.twist
        data = _DOUBLES.pack(pose.x, pose.y, pose.yaw, twist.linear, twist.angular, *e.positions)
        before = zlib.crc32(data, before)
    return before


def input_names(inputs: Inputs, before: int) -> int:
    """Return the CRC-32 of the names in a batch of steps, up to and including this step.

    It covers the names of sources, senders and clients in the inputs.

    Args:
        inputs: the inputs of this step.
        before: the CRC-32 of the earlier steps of the batch; 0 for the first step.
    """
    names = [
        *[name for command in inputs.commands for name in (command.source, command.sender)],
        *[request.by for request in inputs.requests],
        *[name for refusal in inputs.refusals for name in (refusal.source, refusal.sender)],
        *[event.by for event in inputs.events],
        *([] if inputs.speed_cap is None else [inputs.speed_cap.by]),
    ]
    # Most steps contain no names. The JSON encoding shows where each name ends.
    return zlib.crc32(msgspec.json.encode(names), before) if names else before


def count_superseded(commands: Sequence[Command]) -> int:
    """Return the number of commands that are followed by a newer command of the same sender.

    `commands` are the commands of one step, in order.
    """
    return len(commands) - len({(command.source, command.sender) for command in commands})


def status_of(outputs: Outputs) -> Status:
    return outputs.mode, outputs.reason, outputs.link, outputs.source


def micropose(estimate: Estimate) -> Micropose:
    pose = estimate.pose
    return round(pose.x * US_PER_S), round(pose.y * US_PER_S), round(pose.yaw * US_PER_S)
