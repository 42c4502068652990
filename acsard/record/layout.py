"""The layout of a batch of steps, which `batch.py` writes and reads.

A change of this layout is a new format, with a new number in `FORMAT`.
"""

from __future__ import annotations

from typing import NamedTuple

from msgspec import Struct

from acsard.record.columns import Column
from acsard.record.steps import Micropose, Status
from acsard.values import Command, Event, GyroSample, Refusal, Request

FORMAT = "2"
"""Format of the messages in a recording. A new number means a new encoding."""

SAME = "\x00"
"""Stands in place of a status reason that equals the one before."""

TICK, OPEN, AT_ONCE, LEAVING, SUPERSEDED, LINE, LEFT = (1 << n for n in range(7))
"""The bits of `Shape.flags`, each a fact about a step."""


class Rare(Struct, frozen=True, omit_defaults=True):
    """Values that most steps do not have. An absent value is as in the step before, or empty."""

    opened: int | None = None
    trouble: str | None = None
    status: Status | None = None
    left: bytes = b""
    """Bytes that were sent to the board in place of the decided line."""
    missed: int = 0
    guard_trip: str = ""
    commands: tuple[Command, ...] = ()
    requests: tuple[Request, ...] = ()
    refusals: tuple[Refusal, ...] = ()
    gyro: tuple[GyroSample, ...] = ()
    heard: tuple[Event, ...] = ()
    told: tuple[Event, ...] = ()


NOTHING = Rare()


class Shape(NamedTuple):
    """Properties of one step that many other steps share."""

    flags: int
    reads: int
    poses: int
    line: int
    """Length of the line in bytes."""


class Standing(NamedTuple):
    """Values that stay the same for a long time, as they are at the first step of the batch."""

    opened: int
    trouble: str
    status: Status


class Lane(Struct, frozen=True, array_like=True):
    """Steps of one rhythm: the ticks, or all others."""

    kinds: bytes
    """Index into `Batch.shapes` for each step, one byte each."""
    times: Column
    """Time of each step in ns from `Batch.mono_ns`."""


class Batch(Struct, frozen=True, array_like=True):
    """A batch of steps as it is written."""

    first: int
    mono_ns: int
    offset_ns: int
    """Offset of the wall clock from the monotonic clock at the first instant, ns. The columns
    hold differences from this offset and from `mono_ns`.
    """
    standing: Standing
    shapes: tuple[Shape, ...]
    """The distinct shapes of the batch's steps, which are few."""
    ticks: Lane
    others: Lane
    """The steps that are not ticks: a feedback line was read, or a command is sent at once."""
    order: bytes
    """One byte for each step that says whether it is a tick. It is empty if the times give the
    order; of several steps at one time a tick comes first.
    """
    offsets: Column
    """Change of the wall clock's offset from `offset_ns`, ns, at each read and then at the step."""
    ages: Column
    """Age of each read of the port at its step, ns."""
    lengths: Column
    received: bytes
    written: bytes
    """All lines of the batch, joined."""
    xs: Column
    ys: Column
    yaws: Column
    checksum: int
    rare: tuple[tuple[int, Rare], ...]


class Spread(NamedTuple):
    """A batch with its columns unpacked."""

    first: int
    standing: Standing
    shapes: list[Shape]
    """Shape of each step."""
    times: list[int]
    """Monotonic time of each step, ns."""
    offsets: list[int]
    """Offset of the wall clock from the monotonic clock, ns, at each read and then at the step."""
    ages: list[int]
    lengths: list[int]
    received: bytes
    written: bytes
    poses: list[Micropose]
    checksum: int
    rare: dict[int, Rare]
