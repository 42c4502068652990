"""The shape of a batch of steps, as `batch.py` writes and reads it. Another is another format."""

from __future__ import annotations

from typing import NamedTuple

from msgspec import Struct

from acsard.record.steps import Status
from acsard.values import Command, Event, GyroSample, Refusal, Request

TICK, OPEN, AT_ONCE, LEAVING, SUPERSEDED, LINE, LEFT = (1 << n for n in range(7))
"""What is so or not of a step: the bits of `Shape.flags`."""


class Rare(Struct, frozen=True, omit_defaults=True):
    """What most steps have not: absent is as in the step before, or nothing."""

    opened: int | None = None
    trouble: str | None = None
    status: Status | None = None
    left: bytes = b""
    """What left in place of the line."""
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
    """What one step has as many others have it."""

    flags: int
    reads: int
    poses: int
    line: int
    """Bytes."""


class Batch(Struct, frozen=True, array_like=True):
    first: int
    mono_ns: int
    offset_ns: int
    """The two clocks at the first instant: what the columns are differences from."""
    shapes: tuple[Shape, ...]
    """The kinds of steps there are, few of them."""
    count: int
    kinds: bytes
    """Which of the shapes each step has."""
    ticks: bytes
    """ns from the tick before (the first: from `mono_ns`) to each tick."""
    others: bytes
    """ns from the step before to each step that is none."""
    offsets: bytes
    """How the wall clock went against the other from instant to instant: reads, then the step."""
    ages: bytes
    """ns of each read of the port, at its step; then how long it is, and all its bytes."""
    lengths: bytes
    received: bytes
    written: bytes
    """All lines."""
    xs: bytes
    """From pose to pose."""
    ys: bytes
    yaws: bytes
    checksum: int
    rare: tuple[tuple[int, Rare], ...]
