"""Whole numbers of one kind -> bytes that compress well, and back.

Each is told by its difference from the median, in units of what divides all of them, small ones as
small numbers whatever their sign; then all lowest bytes come first, and all next ones: what is
noise and what is zero lie apart.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

_HEAD = struct.Struct("<qqB")

MOST = 1 << 24
"""Numbers in a column: equal ones take no room, so a damaged count could ask for any."""


def pack(values: Sequence[int]) -> bytes:
    """The bytes of `values`, each of at most 62 bits; their count has to be told elsewhere."""
    if not values:
        return b""
    base = sorted(values)[len(values) // 2]
    unit = math.gcd(*[v - base for v in values]) or 1
    steps = [(v - base) // unit for v in values]
    folded = [step << 1 if step >= 0 else ~(step << 1) for step in steps]
    width = (max(folded).bit_length() + 7) // 8
    data = struct.pack(f"<{len(folded)}Q", *folded)
    return _HEAD.pack(base, unit, width) + b"".join([data[n::8] for n in range(width)])


def unpack(data: bytes, count: int) -> list[int]:
    """The `count` numbers again; raises `ValueError` when they do not fit."""
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
