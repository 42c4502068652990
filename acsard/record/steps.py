"""What a recording says of a step: all that came in, and what went out. Steps <-> bytes.

What lives here: the shape of one batch of steps, at most a second of them. Everything in it is
exact but the poses, told in um and urad; a checksum at its end holds every bit of them. What must
not: files, threads.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import NamedTuple

import msgspec
from msgspec import Struct

from acsard.record.columns import pack, unpack
from acsard.values import (
    AcsardError,
    Command,
    Estimate,
    Event,
    GyroSample,
    Inputs,
    Instant,
    Outputs,
    Received,
    Refusal,
    Request,
)

MICRO = 1e6

Status = tuple[str, str, str, str]
"""Mode, reason, link, source."""

Micropose = tuple[int, int, int]
"""x, y in um and yaw in urad."""

TICK, OPEN, AT_ONCE, LEAVING, SUPERSEDED, LINE, LEFT = (1 << n for n in range(7))
_DOUBLES = struct.Struct("<9d")


class BatchError(AcsardError):
    """These bytes are no batch of steps."""


class Taken(NamedTuple):
    """A step as the control loop hands it over: references, nothing copied."""

    inputs: Inputs
    outputs: Outputs
    left: bytes | None
    """What was handed to the port, None when nothing went."""


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


class _Batch(Struct, frozen=True, array_like=True):
    first: int
    count: int
    mono_ns: int
    offset_ns: int
    """The two clocks at the first instant: what the columns are differences from."""
    flags: bytes
    ticks: bytes
    """ns from the tick before (the first: from `mono_ns`) to each tick."""
    others: bytes
    """ns from the step before to each step that is none."""
    offsets: bytes
    """How the wall clock went against the other from instant to instant: reads, then the step."""
    reads: bytes
    """How many reads of the port each step had; of each its age in ns and its bytes."""
    ages: bytes
    lengths: bytes
    received: bytes
    lines: bytes
    written: bytes
    poses: bytes
    """How many each step had; then their differences."""
    xs: bytes
    ys: bytes
    yaws: bytes
    checksum: int
    rare: tuple[tuple[int, _Rare], ...]


_decoder = msgspec.msgpack.Decoder(_Batch)


def checksum(estimates: Sequence[Estimate], before: int) -> int:
    """Goes on from `before`, over all that odometry says, to the last bit."""
    for e in estimates:
        pose, twist = e.pose, e.twist
        data = _DOUBLES.pack(pose.x, pose.y, pose.yaw, twist.linear, twist.angular, *e.positions)
        before = zlib.crc32(data, before)
    return before


def microposes(estimates: Sequence[Estimate]) -> tuple[Micropose, ...]:
    """Their poses as a recording tells them."""
    return tuple([_micro(estimate) for estimate in estimates])


def status_of(outputs: Outputs) -> Status:
    """What `state` says first."""
    return outputs.mode, outputs.reason, outputs.link, outputs.source


def _micro(estimate: Estimate) -> Micropose:
    pose = estimate.pose
    return round(pose.x * MICRO), round(pose.y * MICRO), round(pose.yaw * MICRO)


# encode


def encode(first: int, taken: Sequence[Taken]) -> bytes:
    """The bytes of these steps, the first of them number `first`; at least one."""
    start = _first_instant(taken[0].inputs)
    estimates = [e for t in taken for e in t.outputs.estimates]
    poses = [_micro(e) for e in estimates]
    reads = [(t.inputs.now, read) for t in taken for read in t.inputs.received]
    lines = [t.outputs.line or b"" for t in taken]
    ticks, others = _instants(taken, start.mono_ns)
    return msgspec.msgpack.encode(
        _Batch(
            first=first,
            count=len(taken),
            mono_ns=start.mono_ns,
            offset_ns=start.wall_ns - start.mono_ns,
            flags=bytes([_flags(t) for t in taken]),
            ticks=pack(ticks),
            others=pack(others),
            offsets=pack(_offsets(taken, start.wall_ns - start.mono_ns)),
            reads=pack([len(t.inputs.received) for t in taken]),
            ages=pack([now.mono_ns - read.at.mono_ns for now, read in reads]),
            lengths=pack([len(read.data) for _, read in reads]),
            received=b"".join([read.data for _, read in reads]),
            lines=pack([len(line) for line in lines]),
            written=b"".join(lines),
            poses=pack([len(t.outputs.estimates) for t in taken]),
            xs=_differences([pose[0] for pose in poses]),
            ys=_differences([pose[1] for pose in poses]),
            yaws=_differences([pose[2] for pose in poses]),
            checksum=checksum(estimates, 0),
            rare=tuple(_rare(taken)),
        )
    )


def _first_instant(inputs: Inputs) -> Instant:
    return inputs.received[0].at if inputs.received else inputs.now


def _flags(taken: Taken) -> int:
    inputs = taken.inputs
    return (
        TICK * inputs.tick
        | OPEN * inputs.port_open
        | AT_ONCE * inputs.at_once
        | LEAVING * inputs.leaving
        | SUPERSEDED * inputs.superseded
        | LINE * (taken.outputs.line is not None)
        | LEFT * (taken.left is not None)
    )


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
    if len(batch.flags) != batch.count:
        raise ValueError("flags for another number of steps")
    reads, nows = _reads(batch), iter(_nows(batch))
    lines = _cut(batch.written, unpack(batch.lines, batch.count))
    poses = _poses(batch)
    rares = dict(batch.rare)
    opened, trouble, status = 0, "", ("", "", "", "")
    for index, flags in enumerate(batch.flags):
        rare = rares.get(index, _NOTHING)
        opened = opened if rare.opened is None else rare.opened
        trouble = trouble if rare.trouble is None else rare.trouble
        status = status if rare.status is None else rare.status
        line = next(lines)
        inputs = Inputs(
            now=next(nows),
            tick=bool(flags & TICK),
            at_once=bool(flags & AT_ONCE),
            port_open=bool(flags & OPEN),
            opened=opened,
            port_trouble=trouble,
            received=next(reads),
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
            poses=next(poses),
            events=rare.told,
            checksum=batch.checksum if index == batch.count - 1 else None,
        )
        yield Step(batch.first + index, inputs, said, begins=index == 0)


def _counts(data: bytes, count: int) -> list[int]:
    counts = unpack(data, count)
    if min(counts, default=0) < 0 or sum(counts) > 1 << 24:
        raise ValueError("no such number")
    return counts


def _step_times(batch: _Batch) -> Iterator[int]:
    ticks = sum(1 for flags in batch.flags if flags & TICK)
    tick_deltas = iter(unpack(batch.ticks, ticks))
    deltas = iter(unpack(batch.others, batch.count - ticks))
    last = last_tick = batch.mono_ns
    for flags in batch.flags:
        if flags & TICK:
            last = last_tick = last_tick + next(tick_deltas)
        else:
            last += next(deltas)
        yield last


def _instants_of(batch: _Batch) -> Iterator[tuple[list[Instant], Instant]]:
    """Of each step: when its reads were, and it itself."""
    counts = _counts(batch.reads, batch.count)
    ages = iter(unpack(batch.ages, sum(counts)))
    deltas = unpack(batch.offsets, sum(counts) + batch.count)
    offsets = accumulate(deltas, initial=batch.offset_ns)
    next(offsets)
    for now_ns, count in zip(_step_times(batch), counts, strict=True):
        at = [now_ns - next(ages) for _ in range(count)]
        instants = [Instant(ns, ns + next(offsets)) for ns in (*at, now_ns)]
        yield instants[:-1], instants[-1]


def _nows(batch: _Batch) -> list[Instant]:
    return [now for _, now in _instants_of(batch)]


def _reads(batch: _Batch) -> Iterator[tuple[Received, ...]]:
    total = sum(_counts(batch.reads, batch.count))
    data = _cut(batch.received, unpack(batch.lengths, total))
    for ats, _ in _instants_of(batch):
        yield tuple([Received(at, next(data)) for at in ats])


def _cut(data: bytes, lengths: list[int]) -> Iterator[bytes]:
    if min(lengths, default=0) < 0 or sum(lengths) != len(data):
        raise ValueError("texts of other lengths")
    at = 0
    for length in lengths:
        yield data[at : at + length]
        at += length


def _poses(batch: _Batch) -> Iterator[tuple[Micropose, ...]]:
    counts = _counts(batch.poses, batch.count)
    columns = [accumulate(unpack(c, sum(counts))) for c in (batch.xs, batch.ys, batch.yaws)]
    every = zip(*columns, strict=True)
    for count in counts:
        yield tuple([_three(*next(every)) for _ in range(count)])


def _three(x: int, y: int, yaw: int) -> Micropose:
    return x, y, yaw
