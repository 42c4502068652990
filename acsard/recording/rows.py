"""Encodes steps as rows, in batches of about one second, and decodes them.

Times and poses are differences from earlier ones, so similar steps give equal bytes, which compress
well. Each batch is decoded alone. A forged one with values that no daemon records is refused. If
you change a struct of this module so that an older version cannot read it, change `FORMAT` as well.
An added field with a default is ignored there, and so is a call of an unknown service.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Annotated, NamedTuple, get_args

import msgspec
from msgspec import Meta, Struct

from acsard.core.values import (
    AcsardError,
    Command,
    Event,
    GyroSample,
    Inputs,
    Instant,
    Ns,
    Received,
    Refusal,
    Request,
    SpeedCap,
    Trip,
    Verb,
)
from acsard.recording.recorded_steps import (
    FinishedStep,
    Micropose,
    RecordedOutputs,
    RecordedStep,
    Status,
    checksum,
    input_names,
    micropose,
    status_of,
)

FORMAT = "4"  # of the messages in a recording

VERBS = frozenset(get_args(Verb))

MAX_ROWS = 4096  # like the recorder's queue

# 73 years: the age of a read, and `late_ns`; a monotonic time has twice as much.
MAX_TIME_NS = 1 << 61

# Wall clock minus monotonic clock, reached in 2116; its sum with a time fits in 64 bits.
MAX_OFFSET_NS = 1 << 62


class BatchError(AcsardError):
    """A recorded batch of steps is damaged, or contains values that no daemon records."""


class OccasionalFields(Struct, frozen=True, omit_defaults=True):
    """Inputs and outputs that are absent or unchanged in most steps."""

    opened: int | None = None  # None: as in the previous row
    trouble: str | None = None  # None: as in the previous row
    status: Status | None = None  # None: as in the previous row
    missed: int = 0
    late_ns: Annotated[int, Meta(ge=0, le=MAX_TIME_NS)] = 0
    guard_trip: Trip = ""
    commands: tuple[Command, ...] = ()
    requests: tuple[Request, ...] = ()
    refusals: tuple[Refusal, ...] = ()
    gyro: tuple[GyroSample, ...] = ()
    speed_cap: SpeedCap | None = None
    events_in: tuple[Event, ...] = ()
    events_out: tuple[Event, ...] = ()


NO_OCCASIONAL_FIELDS = OccasionalFields()


class Read(NamedTuple):
    """The bytes of one read from the serial port; times in `Batch.unit`."""

    age: int  # from the read to its step
    offset: int  # of wall clock minus monotonic clock, since the first step of the batch
    data: bytes


class Row(Struct, frozen=True, array_like=True):
    """One step as a recording stores it; times in `Batch.unit`."""

    tick: bool
    port_open: bool
    at_once: bool
    shutting_down: bool
    superseded: bool
    now: int  # since the last earlier row with a true `tick`, or `Batch.mono_ns`
    offset: int  # of wall clock minus monotonic clock, since the first step of the batch
    reads: tuple[Read, ...]
    line: bytes | None  # that the robot decided to send
    sent: bytes | bool  # True: `line`; False: none; otherwise another line
    # Um and urad, each after the first as the difference from the one before.
    poses: tuple[Micropose, ...]
    rare: OccasionalFields | None  # None: all absent or unchanged


class Batch(Struct, frozen=True, array_like=True):
    first: int  # number, from 0 at the daemon's start
    mono_ns: Ns
    offset_ns: Ns  # wall clock minus monotonic clock
    # ns: greatest common divisor of the times, 1000 or more if the clocks count in us.
    unit: Annotated[int, Meta(ge=1)]
    rows: Annotated[tuple[Row, ...], Meta(min_length=1, max_length=MAX_ROWS)]
    checksum: int  # of exact poses, twists and wheel angles
    names: int | None = None  # CRC-32 of the names in the inputs; None in older files


class _First(Struct, frozen=True, array_like=True):
    number: int


_decoder = msgspec.msgpack.Decoder(Batch)
_decoder_of_first = msgspec.msgpack.Decoder(_First)


# Encoding


def encode(first: int, steps: Sequence[FinishedStep]) -> bytes:
    """Encode 1 to `MAX_ROWS` successive steps as a batch."""
    start = steps[0].inputs.now
    offset_ns = start.wall_ns - start.mono_ns
    times = list(_times(steps, start.mono_ns, offset_ns))
    unit = math.gcd(*chain.from_iterable(times)) or 1
    rares, pose, rows = _rares(steps), (0, 0, 0), []
    for (inputs, outputs, sent), ns, rare in zip(steps, times, rares, strict=True):
        now, offset, *reads = [n // unit for n in ns]
        poses = []
        for estimate in outputs.estimates:
            new = micropose(estimate)
            poses.append((new[0] - pose[0], new[1] - pose[1], new[2] - pose[2]))
            pose = new
        rows.append(
            Row(
                tick=inputs.tick,
                port_open=inputs.port_open,
                at_once=inputs.at_once,
                shutting_down=inputs.shutting_down,
                superseded=inputs.superseded,
                now=now,
                offset=offset,
                reads=tuple(map(Read, reads[::2], reads[1::2], [r.data for r in inputs.received])),
                line=outputs.line,
                sent=False if sent is None else (sent == outputs.line or sent),
                poses=tuple(poses),
                rare=None if rare == NO_OCCASIONAL_FIELDS else rare,
            )
        )
    crc = checksum([e for t in steps for e in t.outputs.estimates], 0)
    names = 0
    for inputs, _, _ in steps:
        names = input_names(inputs, names)
    batch = Batch(first, start.mono_ns, offset_ns, unit, tuple(rows), crc, names)
    return msgspec.msgpack.encode(batch)


def _times(steps: Sequence[FinishedStep], mono_ns: Ns, offset_ns: Ns) -> Iterator[list[int]]:
    # For each step, ns: `Row.now`, `Row.offset`, and for each read its age and offset.
    tick_ns = mono_ns
    for inputs, _, _ in steps:
        now = inputs.now
        times = [now.mono_ns - tick_ns, now.wall_ns - now.mono_ns - offset_ns]
        for read in inputs.received:
            at = read.at
            times += (now.mono_ns - at.mono_ns, at.wall_ns - at.mono_ns - offset_ns)
        if inputs.tick:
            tick_ns = now.mono_ns
        yield times


def _rares(steps: Sequence[FinishedStep]) -> Iterator[OccasionalFields]:
    opened: int | None = None
    trouble: str | None = None
    status: Status | None = None
    for inputs, outputs, _ in steps:
        now = status_of(outputs)
        yield OccasionalFields(
            opened=inputs.opened if inputs.opened != opened else None,
            trouble=inputs.port_trouble if inputs.port_trouble != trouble else None,
            status=now if now != status else None,
            missed=inputs.missed,
            late_ns=inputs.late_ns,
            guard_trip=inputs.guard_trip,
            commands=inputs.commands,
            requests=inputs.requests,
            refusals=inputs.refusals,
            gyro=inputs.gyro,
            speed_cap=inputs.speed_cap,
            events_in=inputs.events,
            events_out=outputs.events,
        )
        opened, trouble, status = inputs.opened, inputs.port_trouble, now


# Decoding


def decode(data: bytes) -> list[RecordedStep]:
    """Return the steps of a batch. Raises `BatchError`."""
    try:
        return list(_steps(_decoder.decode(data)))
    except (msgspec.DecodeError, ValueError) as error:
        raise BatchError(f"the batch of steps is damaged: {error}") from None


def first_of(data: bytes) -> int | None:
    """Return the number of the first step of a batch, or None if it is damaged."""
    try:
        return _decoder_of_first.decode(data).number
    except msgspec.MsgspecError:
        return None


def _steps(batch: Batch) -> Iterator[RecordedStep]:
    first = batch.rows[0].rare or NO_OCCASIONAL_FIELDS
    opened, trouble, status = first.opened, first.trouble, first.status
    tick_ns, pose, last = batch.mono_ns, (0, 0, 0), len(batch.rows) - 1
    for index, row in enumerate(batch.rows):
        rare = row.rare or NO_OCCASIONAL_FIELDS
        _require_finite(rare)
        opened = opened if rare.opened is None else rare.opened
        trouble = trouble if rare.trouble is None else rare.trouble
        status = rare.status or status
        if opened is None or trouble is None or status is None:
            raise ValueError("the first step of the batch has no `opened`, `trouble` or `status`")
        now = _instant(batch, tick_ns + row.now * batch.unit, row.offset)
        received = []
        for read in row.reads:
            age_ns = read.age * batch.unit
            if abs(age_ns) >= MAX_TIME_NS:
                raise ValueError("a time is out of range")
            at = _instant(batch, now.mono_ns - age_ns, read.offset)
            received.append(Received(at, read.data))
        poses = []
        for delta in row.poses:
            pose = (pose[0] + delta[0], pose[1] + delta[1], pose[2] + delta[2])
            poses.append(pose)
        inputs = Inputs(
            now=now,
            tick=row.tick,
            at_once=row.at_once,
            port_open=row.port_open,
            opened=opened,
            port_trouble=trouble,
            received=tuple(received),
            commands=rare.commands,
            requests=tuple([one for one in rare.requests if one.verb in VERBS]),
            refusals=rare.refusals,
            gyro=rare.gyro,
            speed_cap=rare.speed_cap,
            guard_trip=rare.guard_trip,
            superseded=row.superseded,
            missed=rare.missed,
            events=rare.events_in,
            shutting_down=row.shutting_down,
            late_ns=rare.late_ns,
        )
        recorded = RecordedOutputs(
            line=row.line,
            sent=_sent_line(row),
            status=status,
            poses=tuple(poses),
            events=rare.events_out,
            checksum=batch.checksum if index == last else None,
            names=batch.names if index == last else None,
        )
        if row.tick:
            tick_ns = now.mono_ns
        yield RecordedStep(batch.first + index, inputs, recorded, begins=index == 0)


def _sent_line(row: Row) -> bytes | None:
    if row.sent is True:
        return row.line
    return None if row.sent is False else row.sent


def _instant(batch: Batch, mono_ns: Ns, offset: int) -> Instant:
    # Raises `ValueError` if a time is out of range.
    ahead_ns = batch.offset_ns + offset * batch.unit
    if abs(mono_ns) >= 2 * MAX_TIME_NS or abs(ahead_ns) >= MAX_OFFSET_NS:
        raise ValueError("a time is out of range")
    return Instant(mono_ns, mono_ns + ahead_ns)


def _require_finite(rare: OccasionalFields) -> None:
    # Raises `ValueError`. The robot itself checks the numbers in commands.
    for request in rare.requests:
        pose = request.pose
        if pose is not None and not all(map(math.isfinite, (pose.x, pose.y, pose.yaw))):
            raise ValueError("a pose is not finite")
    cap = rare.speed_cap
    if cap is not None and cap.speed is not None and not math.isfinite(cap.speed):
        raise ValueError("a speed limit is not finite")
    for sample in rare.gyro:
        if not (math.isfinite(sample.rate) and math.isfinite(sample.variance)):
            raise ValueError("a gyro sample is not finite")
