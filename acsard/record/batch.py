"""Steps <-> bytes: a batch of at most a second, what is alike in them next to each other.

What lives here: the shape of the bytes. All that is in a `Step` comes back exactly. What must not:
files, threads, what a step means.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import NamedTuple

import msgspec
from msgspec import Struct

from acsard.record.columns import pack, unpack
from acsard.record.steps import Micropose, Said, Status, Step, Taken, checksum, micropose, status_of
from acsard.values import (
    AcsardError,
    Command,
    Event,
    GyroSample,
    Inputs,
    Instant,
    Received,
    Refusal,
    Request,
)

TICK, OPEN, AT_ONCE, LEAVING, SUPERSEDED, LINE, LEFT = (1 << n for n in range(7))


class BatchError(AcsardError):
    """These bytes are no batch of steps."""


class _Rare(Struct, frozen=True, omit_defaults=True):
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


_NOTHING = _Rare()


class _Shape(NamedTuple):
    """What one step has as many others have it."""

    flags: int
    reads: int
    poses: int
    line: int
    """Bytes."""


class _Batch(Struct, frozen=True, array_like=True):
    first: int
    mono_ns: int
    offset_ns: int
    """The two clocks at the first instant: what the columns are differences from."""
    shapes: tuple[_Shape, ...]
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
    rare: tuple[tuple[int, _Rare], ...]


_decoder = msgspec.msgpack.Decoder(_Batch)


# encode


def encode(first: int, taken: Sequence[Taken]) -> bytes:
    """The bytes of these steps, the first of them number `first`; at least one."""
    start = _first_instant(taken[0].inputs)
    offset_ns = start.wall_ns - start.mono_ns
    estimates = [e for t in taken for e in t.outputs.estimates]
    poses = [micropose(e) for e in estimates]
    reads = [(t.inputs.now, read) for t in taken for read in t.inputs.received]
    shapes: dict[_Shape, int] = {}
    kinds = [shapes.setdefault(_shape(t), len(shapes)) for t in taken]
    ticks, others = _instants(taken, start.mono_ns)
    return msgspec.msgpack.encode(
        _Batch(
            first=first,
            mono_ns=start.mono_ns,
            offset_ns=offset_ns,
            shapes=tuple(shapes),
            count=len(taken),
            kinds=pack(kinds),
            ticks=pack(ticks),
            others=pack(others),
            offsets=pack(_offsets(taken, offset_ns)),
            ages=pack([now.mono_ns - read.at.mono_ns for now, read in reads]),
            lengths=pack([len(read.data) for _, read in reads]),
            received=b"".join([read.data for _, read in reads]),
            written=b"".join([t.outputs.line or b"" for t in taken]),
            xs=_differences([pose[0] for pose in poses]),
            ys=_differences([pose[1] for pose in poses]),
            yaws=_differences([pose[2] for pose in poses]),
            checksum=checksum(estimates, 0),
            rare=tuple(_rare(taken)),
        )
    )


def _first_instant(inputs: Inputs) -> Instant:
    return inputs.received[0].at if inputs.received else inputs.now


def _shape(taken: Taken) -> _Shape:
    inputs, line = taken.inputs, taken.outputs.line
    flags = (
        TICK * inputs.tick
        | OPEN * inputs.port_open
        | AT_ONCE * inputs.at_once
        | LEAVING * inputs.leaving
        | SUPERSEDED * inputs.superseded
        | LINE * (line is not None)
        | LEFT * (taken.left is not None)
    )
    return _Shape(flags, len(inputs.received), len(taken.outputs.estimates), len(line or b""))


def _instants(taken: Sequence[Taken], start_ns: int) -> tuple[list[int], list[int]]:
    ticks, others = [], []
    last = last_tick = start_ns
    for t in taken:
        now_ns = t.inputs.now.mono_ns
        if t.inputs.tick:
            ticks.append(now_ns - last_tick)
            last_tick = now_ns
        else:
            others.append(now_ns - last)
        last = now_ns
    return ticks, others


def _offsets(taken: Sequence[Taken], offset_ns: int) -> list[int]:
    found = []
    for t in taken:
        for at in (*[read.at for read in t.inputs.received], t.inputs.now):
            now_ns = at.wall_ns - at.mono_ns
            found.append(now_ns - offset_ns)
            offset_ns = now_ns
    return found


def _differences(values: list[int]) -> bytes:
    return pack([b - a for a, b in zip([0, *values], values, strict=False)])


def _rare(taken: Sequence[Taken]) -> Iterator[tuple[int, _Rare]]:
    opened: int | None = None
    trouble: str | None = None
    status: Status | None = None
    for index, (inputs, outputs, left) in enumerate(taken):
        now = status_of(outputs)
        rare = _Rare(
            opened=inputs.opened if inputs.opened != opened else None,
            trouble=inputs.port_trouble if inputs.port_trouble != trouble else None,
            status=now if now != status else None,
            left=left if left is not None and left != outputs.line else b"",
            missed=inputs.missed,
            guard_trip=inputs.guard_trip,
            commands=inputs.commands,
            requests=inputs.requests,
            refusals=inputs.refusals,
            gyro=inputs.gyro,
            heard=inputs.events,
            told=outputs.events,
        )
        opened, trouble, status = inputs.opened, inputs.port_trouble, now
        if rare != _NOTHING:
            yield index, rare


# decode


def decode(data: bytes) -> list[Step]:
    """The steps again; raises `BatchError` for bytes that are none."""
    try:
        batch = _decoder.decode(data)
        return list(_steps(batch))
    except (msgspec.DecodeError, ValueError, IndexError, StopIteration, RuntimeError) as error:
        raise BatchError(f"not a batch of steps: {error}") from None


def _steps(batch: _Batch) -> Iterator[Step]:
    shapes = _shapes(batch)
    instants = _instants_of(batch, shapes)
    data = _cut(batch.received, unpack(batch.lengths, sum(shape.reads for shape in shapes)))
    lines = _cut(batch.written, [shape.line for shape in shapes])
    poses = _poses(batch, shapes)
    rares = dict(batch.rare)
    opened, trouble, status = 0, "", ("", "", "", "")
    for index, (shape, (ats, now)) in enumerate(zip(shapes, instants, strict=True)):
        flags, rare = shape.flags, rares.get(index, _NOTHING)
        opened = opened if rare.opened is None else rare.opened
        trouble = trouble if rare.trouble is None else rare.trouble
        status = status if rare.status is None else rare.status
        line = next(lines)
        inputs = Inputs(
            now=now,
            tick=bool(flags & TICK),
            at_once=bool(flags & AT_ONCE),
            port_open=bool(flags & OPEN),
            opened=opened,
            port_trouble=trouble,
            received=tuple([Received(at, next(data)) for at in ats]),
            commands=rare.commands,
            requests=rare.requests,
            refusals=rare.refusals,
            gyro=rare.gyro,
            guard_trip=rare.guard_trip,
            superseded=bool(flags & SUPERSEDED),
            missed=rare.missed,
            events=rare.heard,
            leaving=bool(flags & LEAVING),
        )
        said = Said(
            line=line if flags & LINE else None,
            left=(rare.left or line) if flags & LEFT else None,
            status=status,
            poses=tuple([next(poses) for _ in range(shape.poses)]),
            events=rare.told,
            checksum=batch.checksum if index == batch.count - 1 else None,
        )
        yield Step(batch.first + index, inputs, said, begins=index == 0)


def _shapes(batch: _Batch) -> list[_Shape]:
    """Of every step."""
    if min([n for shape in batch.shapes for n in shape], default=0) < 0:
        raise ValueError("a number below 0")
    kinds = unpack(batch.kinds, batch.count)
    if min(kinds, default=0) < 0:
        raise ValueError("no such kind of step")
    return [batch.shapes[kind] for kind in kinds]


def _times(batch: _Batch, shapes: list[_Shape]) -> Iterator[int]:
    ticks = sum(1 for shape in shapes if shape.flags & TICK)
    tick_deltas = iter(unpack(batch.ticks, ticks))
    deltas = iter(unpack(batch.others, batch.count - ticks))
    last = last_tick = batch.mono_ns
    for shape in shapes:
        if shape.flags & TICK:
            last = last_tick = last_tick + next(tick_deltas)
        else:
            last += next(deltas)
        yield last


def _instants_of(batch: _Batch, shapes: list[_Shape]) -> Iterator[tuple[list[Instant], Instant]]:
    """Of each step: when its reads were, and it itself."""
    reads = sum(shape.reads for shape in shapes)
    ages = iter(unpack(batch.ages, reads))
    deltas = unpack(batch.offsets, reads + batch.count)
    offsets = accumulate(deltas, initial=batch.offset_ns)
    next(offsets)
    for now_ns, shape in zip(_times(batch, shapes), shapes, strict=True):
        times = [now_ns - next(ages) for _ in range(shape.reads)]
        instants = [Instant(ns, ns + next(offsets)) for ns in (*times, now_ns)]
        yield instants[:-1], instants[-1]


def _cut(data: bytes, lengths: list[int]) -> Iterator[bytes]:
    if min(lengths, default=0) < 0 or sum(lengths) != len(data):
        raise ValueError("texts of other lengths")
    at = 0
    for length in lengths:
        yield data[at : at + length]
        at += length


def _poses(batch: _Batch, shapes: list[_Shape]) -> Iterator[Micropose]:
    count = sum(shape.poses for shape in shapes)
    columns = [accumulate(unpack(column, count)) for column in (batch.xs, batch.ys, batch.yaws)]
    return (_three(*pose) for pose in zip(*columns, strict=True))


def _three(x: int, y: int, yaw: int) -> Micropose:
    return x, y, yaw
