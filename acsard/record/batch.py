"""Encodes steps as batches of at most about one second, and decodes them.

A batch stores equal kinds of values next to each other, in the layout of `layout.py`. Decoding
returns every `Step` exactly as it was encoded.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec
from msgspec import Struct

from acsard.record.columns import pack, unpack
from acsard.record.layout import (
    AT_ONCE,
    LEAVING,
    LEFT,
    LINE,
    NOTHING,
    OPEN,
    SAME,
    SUPERSEDED,
    TICK,
    Batch,
    Lane,
    Rare,
    Shape,
    Spread,
    Standing,
)
from acsard.record.plausible import implausible
from acsard.record.steps import Said, Status, Step, Taken, checksum, micropose, status_of
from acsard.values import (
    AcsardError,
    Inputs,
    Instant,
    Received,
)


class _First(Struct, frozen=True, array_like=True):
    """The part of a batch that `first_of` decodes."""

    number: int


class BatchError(AcsardError):
    """Bytes that are not a valid batch of steps."""


_decoder = msgspec.msgpack.Decoder(Batch)
_decoder_of_first = msgspec.msgpack.Decoder(_First)


# Encoding


def encode(first: int, taken: Sequence[Taken], reason: str | None = None) -> bytes:
    """Encode 1 to 256 steps; the first of them has the number `first`.

    `reason` is the status reason of the last step of the batch before, or None for the first batch
    of a file. A reason is a long text that often stays the same for hours, so a repeated one is not
    stored.
    """
    inputs, outputs, _ = taken[0]
    start = _first_instant(inputs)
    estimates = [e for t in taken for e in t.outputs.estimates]
    poses = [micropose(e) for e in estimates]
    reads = [(t.inputs.now, read) for t in taken for read in t.inputs.received]
    shapes: dict[Shape, int] = {}
    ticks, others = (
        _lane([t for t in taken if t.inputs.tick == tick], start, shapes) for tick in (True, False)
    )
    status = status_of(outputs)
    standing = Standing(inputs.opened, inputs.port_trouble, _brief(status, reason))
    return msgspec.msgpack.encode(
        Batch(
            first=first,
            mono_ns=start.mono_ns,
            offset_ns=start.wall_ns - start.mono_ns,
            standing=standing,
            shapes=tuple(shapes),
            ticks=ticks,
            others=others,
            order=_order(taken),
            offsets=pack(_offsets(taken, start.wall_ns - start.mono_ns)),
            ages=pack([now.mono_ns - read.at.mono_ns for now, read in reads]),
            lengths=pack([len(read.data) for _, read in reads]),
            received=b"".join([read.data for _, read in reads]),
            written=b"".join([t.outputs.line or b"" for t in taken]),
            xs=pack([pose[0] for pose in poses]),
            ys=pack([pose[1] for pose in poses]),
            yaws=pack([pose[2] for pose in poses]),
            checksum=checksum(estimates, 0),
            rare=tuple(_rare(taken, status)),
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


def _lane(taken: list[Taken], start: Instant, shapes: dict[Shape, int]) -> Lane:
    """Encode the steps of one lane, and add their new shapes to `shapes`."""
    kinds = bytes([shapes.setdefault(_shape(t), len(shapes)) for t in taken])
    return Lane(kinds, pack([t.inputs.now.mono_ns - start.mono_ns for t in taken]))


def _order(taken: Sequence[Taken]) -> bytes:
    keys = [(t.inputs.now.mono_ns, not t.inputs.tick) for t in taken]
    return b"" if keys == sorted(keys) else bytes([t.inputs.tick for t in taken])


def _offsets(taken: Sequence[Taken], offset_ns: int) -> list[int]:
    return [
        at.wall_ns - at.mono_ns - offset_ns
        for t in taken
        for at in (*[read.at for read in t.inputs.received], t.inputs.now)
    ]


def _rare(taken: Sequence[Taken], status: Status) -> Iterator[tuple[int, Rare]]:
    opened, trouble = taken[0].inputs.opened, taken[0].inputs.port_trouble
    for index, (inputs, outputs, left) in enumerate(taken):
        now = status_of(outputs)
        rare = Rare(
            opened=inputs.opened if inputs.opened != opened else None,
            trouble=inputs.port_trouble if inputs.port_trouble != trouble else None,
            status=_brief(now, status[1]) if now != status else None,
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
        if rare != NOTHING:
            yield index, rare


def _brief(status: Status, reason: str | None) -> Status:
    mode, now, link, source = status
    return mode, SAME if now == reason else now, link, source


# Decoding


def decode(data: bytes, reason: str = "") -> list[Step]:
    """Decode a batch.

    Args:
        data: the bytes of the batch.
        reason: the status reason of the last step of the batch before.

    Raises:
        BatchError: the bytes are not a valid batch.
    """
    try:
        spread = _spread(_decoder.decode(data))
        if why := implausible(spread):
            raise ValueError(why)
        return list(_steps(spread, reason))
    except (msgspec.DecodeError, ValueError, IndexError, StopIteration, RuntimeError) as error:
        raise BatchError(f"not a batch of steps: {error}") from None


def first_of(data: bytes) -> int | None:
    """Return the number of the first step of a batch, or None for other bytes."""
    try:
        return _decoder_of_first.decode(data).number
    except msgspec.MsgspecError:
        return None


def _spread(batch: Batch) -> Spread:
    if min([n for shape in batch.shapes for n in shape], default=0) < 0:
        raise ValueError("a number below 0")
    placed = _placed(batch)
    shapes = [batch.shapes[kind] for _, _, kind in placed]
    reads = sum(shape.reads for shape in shapes)
    poses = sum(shape.poses for shape in shapes)
    columns = [unpack(column, poses) for column in (batch.xs, batch.ys, batch.yaws)]
    return Spread(
        first=batch.first,
        standing=batch.standing,
        shapes=shapes,
        times=[batch.mono_ns + ns for ns, _, _ in placed],
        offsets=[batch.offset_ns + n for n in unpack(batch.offsets, reads + len(shapes))],
        ages=unpack(batch.ages, reads),
        lengths=unpack(batch.lengths, reads),
        received=batch.received,
        written=batch.written,
        poses=[(x, y, yaw) for x, y, yaw in zip(*columns, strict=True)],
        checksum=batch.checksum,
        rare=dict(batch.rare),
    )


def _times(lane: Lane) -> list[int]:
    return unpack(lane.times, len(lane.kinds))


def _placed(batch: Batch) -> list[tuple[int, bool, int]]:
    """Return for each step the ns since `mono_ns`, whether it is not a tick, and its shape
    index.
    """
    ticks, others = (
        [(ns, late, kind) for ns, kind in zip(_times(lane), lane.kinds, strict=True)]
        for late, lane in ((False, batch.ticks), (True, batch.others))
    )
    if not batch.order:
        return sorted([*ticks, *others], key=lambda one: one[:2])
    if batch.order.count(0) != len(others) or len(batch.order) != len(ticks) + len(others):
        raise ValueError("an order of other steps")
    lanes = iter(others), iter(ticks)
    return [next(lanes[bool(tick)]) for tick in batch.order]


def _steps(spread: Spread, reason: str) -> Iterator[Step]:
    data = _cut(spread.received, spread.lengths)
    lines = _cut(spread.written, [shape.line for shape in spread.shapes])
    poses, instants = iter(spread.poses), _instants(spread)
    opened, trouble, brief = spread.standing
    status = _whole(brief, reason)
    last = len(spread.shapes) - 1
    for index, (shape, (ats, now)) in enumerate(zip(spread.shapes, instants, strict=True)):
        flags, rare = shape.flags, spread.rare.get(index, NOTHING)
        opened = opened if rare.opened is None else rare.opened
        trouble = trouble if rare.trouble is None else rare.trouble
        if rare.status is not None:
            status = _whole(rare.status, status[1])
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
            checksum=spread.checksum if index == last else None,
        )
        yield Step(spread.first + index, inputs, said, begins=index == 0)


def _whole(brief: Status, reason: str) -> Status:
    mode, told, link, source = brief
    return mode, reason if told == SAME else told, link, source


def _instants(spread: Spread) -> Iterator[tuple[list[Instant], Instant]]:
    """Yield for each step the instants of its port reads and its own instant."""
    ages, offsets = iter(spread.ages), iter(spread.offsets)
    for now_ns, shape in zip(spread.times, spread.shapes, strict=True):
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
