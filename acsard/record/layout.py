"""The shape of a batch of steps, as `batch.py` writes and reads it. Another is another format:
what reads this one goes to a module of its own then, as `earlier.py` is for the first.
"""

from __future__ import annotations

from typing import NamedTuple

from msgspec import Struct

from acsard.record.columns import Column
from acsard.record.steps import Micropose, Status
from acsard.values import Command, Event, GyroSample, Refusal, Request

FORMAT = "2"
"""Of what is in a recording: another number is another meaning."""

SAME = "\x00"
"""In place of a reason: as before."""

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


class Standing(NamedTuple):
    """What stays for long; as it was at the first step."""

    opened: int
    trouble: str
    status: Status


class Lane(Struct, frozen=True, array_like=True):
    """Steps that come in their own rhythm."""

    kinds: bytes
    """Which of the shapes each has."""
    times: Column
    """ns from `mono_ns`."""


class Batch(Struct, frozen=True, array_like=True):
    """As it is written."""

    first: int
    mono_ns: int
    offset_ns: int
    """The two clocks at the first instant: what the columns are differences from."""
    standing: Standing
    shapes: tuple[Shape, ...]
    """The kinds of steps there are, few of them."""
    ticks: Lane
    others: Lane
    """The steps that are no ticks: a line was read, or a command is to go at once."""
    order: bytes
    """Of each step whether it is a tick; empty where their times say it (a tick is the first of
    several at one time)."""
    offsets: Column
    """How the wall clock went against the other since: at each read, then at its step."""
    ages: Column
    """ns of each read of the port, at its step; then how long it is, and all its bytes."""
    lengths: Column
    received: bytes
    written: bytes
    """All lines."""
    xs: Column
    ys: Column
    yaws: Column
    checksum: int
    rare: tuple[tuple[int, Rare], ...]


class Spread(NamedTuple):
    """A batch with its columns unpacked, of whatever format."""

    first: int
    standing: Standing
    shapes: list[Shape]
    """Of each step."""
    times: list[int]
    """Of each step, monotonic ns."""
    offsets: list[int]
    """ns from the monotonic clock to the wall clock: at each read, then at its step."""
    ages: list[int]
    lengths: list[int]
    received: bytes
    written: bytes
    poses: list[Micropose]
    checksum: int
    rare: dict[int, Rare]
