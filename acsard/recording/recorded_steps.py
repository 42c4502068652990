"""One control step as a recording stores it: all inputs, and the outputs that are worth comparing.

Poses are rounded to um and urad, and a checksum of the exact values shows smaller differences.
`rows.py` encodes batches of steps.
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
    Estimate,
    Event,
    Inputs,
    Outputs,
    Recording,
)
from acsard.host.errors import MSGSPEC_ERRORS

US_PER_S = 1e6

Status = tuple[str, str, str, str, str]  # mode, its reason, link, source that commands, code

Micropose = tuple[int, int, int]  # x and y in um, yaw in urad

_DOUBLES = struct.Struct("<9d")


class FinishedStep(NamedTuple):
    inputs: Inputs
    outputs: Outputs
    sent: bytes | None  # line on the serial port


class StateBeforeStep(NamedTuple):
    """The state before the step `number`, for a new file or a checkpoint."""

    number: int
    state: bytes  # `state.freeze`; empty for a new robot
    config: Config  # with all changes since the daemon's start


def split_at_states(
    items: list[FinishedStep | StateBeforeStep],
) -> Iterator[tuple[StateBeforeStep | None, list[FinishedStep]]]:
    """Split the recorder's queue into each state (first None) and the steps that follow it."""
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
    # Of all steps of a batch, in its last step (`checksum`, `input_names`)
    checksum: int | None = None
    # Of all steps of a batch, in its last step (`checksum`, `input_names`)
    names: int | None = None


class RecordedStep(Struct, frozen=True):
    number: int  # from 0 at the daemon's start
    inputs: Inputs
    recorded: RecordedOutputs
    begins: bool = False  # first of a batch: the checksums restart at 0

    @property
    def places(self) -> bool:
        """Whether a request sets the pose, after the poses of this step."""
        verbs = [request.verb for request in self.inputs.requests]
        return "set_pose" in verbs or "reset_odometry" in verbs


class UnfinishedError(AcsardError):
    """The inputs of the step in which the daemon failed cannot be decoded."""


class Unfinished(Struct, frozen=True):
    """Inputs of the step in which the daemon failed, for the channel `unfinished`."""

    number: int  # from 0 at the daemon's start
    inputs: Inputs

    def encode(self) -> bytes:
        # The encoding contains the field names, because a later version may add fields.
        return msgspec.msgpack.encode(self)


_unfinished = msgspec.msgpack.Decoder(Unfinished)


def unfinished(data: bytes) -> Unfinished:
    """Decode a message of the channel `unfinished`. Raises `UnfinishedError`."""
    try:
        return _unfinished.decode(data)
    except MSGSPEC_ERRORS as error:
        raise UnfinishedError(
            f"the step in which the daemon failed cannot be read: {error}"
        ) from None


def checksum(estimates: Sequence[Estimate], before: int) -> int:
    """Return the CRC-32 of all bits of a batch's poses, twists and angles, up to this step."""
    for e in estimates:
        pose, twist = e.pose, e.twist
        data = _DOUBLES.pack(pose.x, pose.y, pose.yaw, twist.linear, twist.angular, *e.positions)
        before = zlib.crc32(data, before)
    return before


def input_names(inputs: Inputs, before: int) -> int:
    """Return the CRC-32 of the names of sources, senders and clients up to this step."""
    names = [
        *[name for command in inputs.commands for name in (command.source, command.sender)],
        *[request.by for request in inputs.requests],
        *[name for refusal in inputs.refusals for name in (refusal.source, refusal.sender)],
        *[event.by for event in inputs.events],
        *([] if inputs.speed_cap is None else [inputs.speed_cap.by]),
    ]
    # Most steps contain no names. The JSON encoding shows where each name ends.
    return zlib.crc32(msgspec.json.encode(names), before) if names else before


def status_of(outputs: Outputs) -> Status:
    return outputs.mode, outputs.reason, outputs.link, outputs.source, outputs.code


def micropose(estimate: Estimate) -> Micropose:
    pose = estimate.pose
    return round(pose.x * US_PER_S), round(pose.y * US_PER_S), round(pose.yaw * US_PER_S)
