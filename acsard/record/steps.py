"""A step as a recording tells it: all that came in, and what went out.

The poses are told in um and urad; a checksum holds every bit of all estimates. How many steps
become bytes is `batch.py`'s.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import msgspec
from msgspec import Struct

from acsard.config.settings import Config
from acsard.guard import Guard
from acsard.robot import Robot
from acsard.values import AcsardError, Estimate, Event, Inputs, Outputs, Recording

MICRO = 1e6

Status = tuple[str, str, str, str]
"""Mode, reason, link, source."""

Micropose = tuple[int, int, int]
"""x, y in um and yaw in urad."""

_DOUBLES = struct.Struct("<9d")


class Taken(NamedTuple):
    """A step as the control loop hands it over: references, nothing copied."""

    inputs: Inputs
    outputs: Outputs
    left: bytes | None
    """What was handed to the port, None when nothing went."""


class Start(NamedTuple):
    """What a file begins with: the robot after the step before number `number`."""

    number: int
    state: bytes
    config: Config
    """In force then: settings may have been changed since the daemon began."""


def runs(items: list[Taken | Start]) -> Iterator[tuple[Start | None, list[Taken]]]:
    """What follows without a break, and what it begins with if it begins anew."""
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
    """What records every step, and never waits."""

    def begins(self, robot: Robot, guard: Guard) -> None:
        """Record the robot and its guard before the first step."""

    def step(
        self, inputs: Inputs, outputs: Outputs, left: bytes | None, robot: Robot, guard: Guard
    ) -> None:
        """Take a step that is over. `left` is the line of it that left, or None."""

    def died(self, inputs: Inputs) -> None:
        """A fault of our own ended the step that these came into; the daemon ends by it."""

    @property
    def status(self) -> Recording:
        """How it does."""


class Said(Struct, frozen=True):
    """What a step decided."""

    line: bytes | None
    left: bytes | None
    status: Status
    poses: tuple[Micropose, ...]
    """One for each feedback line that was believed."""
    events: tuple[Event, ...] = ()
    checksum: int | None = None
    """Of all estimates since the first step of the batch, to the last bit; with its last step."""


class Step(Struct, frozen=True):
    """One step again; `number` counts them since the start of the daemon."""

    number: int
    inputs: Inputs
    said: Said
    begins: bool = False
    """The first of its batch: `checksum` begins anew."""


class UnfinishedError(AcsardError):
    """These bytes are no step that was not finished."""


class Unfinished(Struct, frozen=True):
    """A step that a fault of the daemon's own ended: what came into it. Nothing came out of it."""

    number: int
    inputs: Inputs

    def encode(self) -> bytes:
        """With the names of its parts: a later version may add some."""
        return msgspec.msgpack.encode(self)


_unfinished = msgspec.msgpack.Decoder(Unfinished)


def unfinished(data: bytes) -> Unfinished:
    """That step again; raises `UnfinishedError` for bytes that are none."""
    try:
        return _unfinished.decode(data)
    except msgspec.MsgspecError as error:
        raise UnfinishedError(f"not a step that was not finished: {error}") from None


def checksum(estimates: Sequence[Estimate], before: int) -> int:
    """Goes on from `before`, over all that odometry says, to the last bit."""
    for e in estimates:
        pose, twist = e.pose, e.twist
        data = _DOUBLES.pack(pose.x, pose.y, pose.yaw, twist.linear, twist.angular, *e.positions)
        before = zlib.crc32(data, before)
    return before


def microposes(estimates: Sequence[Estimate]) -> tuple[Micropose, ...]:
    """The poses of all of them."""
    return tuple([micropose(estimate) for estimate in estimates])


def status_of(outputs: Outputs) -> Status:
    """What `state` says first."""
    return outputs.mode, outputs.reason, outputs.link, outputs.source


def micropose(estimate: Estimate) -> Micropose:
    """Its pose as a recording tells it."""
    pose = estimate.pose
    return round(pose.x * MICRO), round(pose.y * MICRO), round(pose.yaw * MICRO)
