"""Steps <-> bytes: a batch of at most a second, what is alike in them next to each other.

The shape of the bytes is `layout.py`'s. All that is in a `Step` comes back exactly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import accumulate

import msgspec

from acsard.record.columns import pack, unpack
from acsard.record.layout import (
    AT_ONCE,
    LEAVING,
    LEFT,
    LINE,
    NOTHING,
    OPEN,
    SUPERSEDED,
    TICK,
    Batch,
    Rare,
    Shape,
)
from acsard.record.steps import Micropose, Said, Status, Step, Taken, checksum, micropose, status_of
from acsard.values import (
    AcsardError,
    Inputs,
    Instant,
    Received,
)

SAME = "\x00"
"""In place of a reason: as before."""


class BatchError(AcsardError):
    """These bytes are no batch of steps."""


_decoder = msgspec.msgpack.Decoder(Batch)


# encode


def encode(first: int, taken: Sequence[Taken], reason: str | None = None) -> bytes:
    """The bytes of these steps, the first of them number `first`; at least one.

    `reason` is the last one of the batch before, where there is one in the same file: long words
    that stay the same for hours.
    """
    start = _first_instant(taken[0].inputs)
    offset_ns = start.wall_ns - start.mono_ns
    estimates = [e for t in taken for e in t.outputs.estimates]
    poses = [micropose(e) for e in estimates]
    reads = [(t.inputs.now, read) for t in taken for read in t.inputs.received]
    shapes: dict[Shape, int] = {}
    kinds = [shapes.setdefault(_shape(t), len(shapes)) for t in taken]
    ticks, others = _instants(taken, start.mono_ns)
    return msgspec.msgpack.encode(
        Batch(
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
            rare=tuple(_rare(taken, reason)),
        )
    )


def _first_instant(inputs: Inputs) -> Instant:
    return inputs.received[0].at if inputs.received else inputs.now


def _shape(taken: Taken) -> Shape:
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
    return Shape(flags, len(inputs.received), len(taken.outputs.estimates), len(line or b""))


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


def _rare(taken: Sequence[Taken], reason: str | None) -> Iterator[tuple[int, Rare]]:
    opened: int | None = None
    trouble: str | None = None
    status: Status | None = None
    for index, (inputs, outputs, left) in enumerate(taken):
        now = status_of(outputs)
        rare = Rare(
            opened=inputs.opened if inputs.opened != opened else None,
            trouble=inputs.port_trouble if inputs.port_trouble != trouble else None,
            status=_brief(now, reason) if now != status else None,
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
        opened, trouble, status, reason = inputs.opened, inputs.port_trouble, now, now[1]
        if rare != NOTHING:
            yield index, rare


def _brief(status: Status, reason: str | None) -> Status:
    mode, now, link, source = status
    return mode, SAME if now == reason else now, link, source


# decode


def decode(data: bytes, reason: str = "") -> list[Step]:
    """The steps again; raises `BatchError` for bytes that are none.

    `reason` is the last one of the batch before.
    """
    try:
        batch = _decoder.decode(data)
        return list(_steps(batch, reason))
    except (msgspec.DecodeError, ValueError, IndexError, StopIteration, RuntimeError) as error:
        raise BatchError(f"not a batch of steps: {error}") from None


def _steps(batch: Batch, reason: str) -> Iterator[Step]:
    shapes = _shapes(batch)
    instants = _instants_of(batch, shapes)
    data = _cut(batch.received, unpack(batch.lengths, sum(shape.reads for shape in shapes)))
    lines = _cut(batch.written, [shape.line for shape in shapes])
    poses = _poses(batch, shapes)
    rares = dict(batch.rare)
    opened, trouble, status = 0, "", ("", "", "", "")
    for index, (shape, (ats, now)) in enumerate(zip(shapes, instants, strict=True)):
        flags, rare = shape.flags, rares.get(index, NOTHING)
        opened = opened if rare.opened is None else rare.opened
        trouble = trouble if rare.trouble is None else rare.trouble
        if rare.status is not None:
            mode, told, link, source = rare.status
            reason = reason if told == SAME else told
            status = mode, reason, link, source
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


def _shapes(batch: Batch) -> list[Shape]:
    """Of every step."""
    if min([n for shape in batch.shapes for n in shape], default=0) < 0:
        raise ValueError("a number below 0")
    kinds = unpack(batch.kinds, batch.count)
    if min(kinds, default=0) < 0:
        raise ValueError("no such kind of step")
    return [batch.shapes[kind] for kind in kinds]


def _times(batch: Batch, shapes: list[Shape]) -> Iterator[int]:
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


def _instants_of(batch: Batch, shapes: list[Shape]) -> Iterator[tuple[list[Instant], Instant]]:
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


def _poses(batch: Batch, shapes: list[Shape]) -> Iterator[Micropose]:
    count = sum(shape.poses for shape in shapes)
    columns = [accumulate(unpack(column, count)) for column in (batch.xs, batch.ys, batch.yaws)]
    return (_three(*pose) for pose in zip(*columns, strict=True))


def _three(x: int, y: int, yaw: int) -> Micropose:
    return x, y, yaw
