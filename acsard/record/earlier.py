"""Reads batches of format 1, which recordings had until version 0.1.0.

Nothing writes this format any more. A column of format 1 holds the difference of each number from
the median, in units of the common divisor of all differences. All lowest bytes come first, then all
second bytes, and so on.
"""

from __future__ import annotations

import struct
from itertools import accumulate

from msgspec import Struct

from acsard.record.columns import MOST
from acsard.record.layout import SAME, TICK, Rare, Shape, Spread, Standing
from acsard.record.steps import Micropose

FORMAT = "1"

_HEAD = struct.Struct("<qqB")


class Batch1(Struct, frozen=True, array_like=True):
    first: int
    mono_ns: int
    offset_ns: int
    shapes: tuple[Shape, ...]
    count: int
    kinds: bytes
    ticks: bytes
    """Column with the ns from each tick to the next; the first counts from `mono_ns`."""
    others: bytes
    """Column with the ns from the step before to each step that is not a tick."""
    offsets: bytes
    """Column with the change of the wall clock's offset from instant to instant, ns."""
    ages: bytes
    lengths: bytes
    received: bytes
    written: bytes
    xs: bytes
    """Column with the change from pose to pose, um; `ys` and `yaws` alike, `yaws` in urad."""
    ys: bytes
    yaws: bytes
    checksum: int
    rare: tuple[tuple[int, Rare], ...]


def spread(batch: Batch1) -> Spread:
    """Unpack the columns of a batch.

    Raises `ValueError` or `IndexError` if their lengths do not match.
    """
    if min([n for shape in batch.shapes for n in shape], default=0) < 0:
        raise ValueError("a number below 0")
    kinds = unpack(batch.kinds, batch.count)
    if min(kinds, default=0) < 0:
        raise ValueError("no such kind of step")
    shapes = [batch.shapes[kind] for kind in kinds]
    reads = sum(shape.reads for shape in shapes)
    offsets = accumulate(unpack(batch.offsets, reads + batch.count), initial=batch.offset_ns)
    return Spread(
        first=batch.first,
        standing=Standing(0, "", ("", SAME, "", "")),
        shapes=shapes,
        times=_times(batch, shapes),
        offsets=list(offsets)[1:],
        ages=unpack(batch.ages, reads),
        lengths=unpack(batch.lengths, reads),
        received=batch.received,
        written=batch.written,
        poses=_poses(batch, sum(shape.poses for shape in shapes)),
        checksum=batch.checksum,
        rare=dict(batch.rare),
    )


def unpack(data: bytes, count: int) -> list[int]:
    """Return the `count` numbers of a column.

    Raises `ValueError` if the column does not hold them.
    """
    if not count:
        return []
    if count > MOST or len(data) < _HEAD.size:
        raise ValueError("a column without its head, or of too many numbers")
    base, unit, width = _HEAD.unpack_from(data)
    if width > 8 or len(data) != _HEAD.size + width * count:
        raise ValueError("a column of another length")
    planes = bytearray(8 * count)
    for n in range(width):
        start = _HEAD.size + n * count
        planes[n::8] = data[start : start + count]
    folded = struct.unpack(f"<{count}Q", planes)
    return [base + unit * (value >> 1 if value & 1 == 0 else ~(value >> 1)) for value in folded]


def _times(batch: Batch1, shapes: list[Shape]) -> list[int]:
    ticks = sum(1 for shape in shapes if shape.flags & TICK)
    tick_deltas = iter(unpack(batch.ticks, ticks))
    deltas = iter(unpack(batch.others, batch.count - ticks))
    last = last_tick = batch.mono_ns
    times = []
    for shape in shapes:
        if shape.flags & TICK:
            last = last_tick = last_tick + next(tick_deltas)
        else:
            last += next(deltas)
        times.append(last)
    return times


def _poses(batch: Batch1, count: int) -> list[Micropose]:
    columns = [accumulate(unpack(column, count)) for column in (batch.xs, batch.ys, batch.yaws)]
    return [(x, y, yaw) for x, y, yaw in zip(*columns, strict=True)]
