"""Packs a column of integers into few bits, and unpacks it.

A column stores the difference of each number from its predicted value. The prediction is a straight
line, the number before plus a constant step, or the number eight places before plus a constant
step. Differences are counted in units of their common divisor and written as exponential Golomb
codes. A small difference of either sign takes few bits, a large one takes as many as it needs.
`pack` tries the predictions and keeps the shortest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from msgspec import Struct

PLACES = (1, 8)
"""Distances, in places, to the number from which the next one is predicted.

A source that serves several things in turn takes a time of its own for each; the simulated board
has a cycle of eight.
"""

EXACT = -1
"""Stands in place of `Column.order` if every number equals its prediction, so no codes follow."""

MOST = 1 << 16
"""Largest count of numbers in a column. An exact column takes no bytes, so without this bound a
damaged count could ask for any amount of memory.
"""

LONGEST = 64
"""Largest order of the codes, and largest number of leading zeros in a code."""


class Column(Struct, frozen=True, array_like=True):
    """Packed integers. Their count is not part of the column."""

    places: int = 0
    """Distance to the number that predicts the next one; 0 if a straight line predicts all."""
    order: int = EXACT
    """Order of the exponential Golomb codes: a small difference has about this number of bits."""
    base: int = 0
    """Value at which the straight line begins, or the first number for the other predictions."""
    unit: int = 1
    rise: int = 0
    """Total rise of the straight line from the first number to the last, or the constant step,
    both in units of `unit`.
    """
    bits: bytes = b""
    """The codes, after a leading bit that is always set."""


EMPTY = Column()


def pack(values: Sequence[int]) -> Column:
    """Pack `values` into the shortest column. Each value has at most 62 bits."""
    if not values:
        return EMPTY
    first = values[0]
    unit = math.gcd(*[value - first for value in values])
    if not unit:
        return Column(base=first)
    units = [(value - first) // unit for value in values]
    tries = [_along(units, 0), _along(units, _rise(units))]
    tries += [_from_before(units, places) for places in PLACES if places < len(units)]
    best = min(tries, key=lambda one: sum(map(int.bit_length, one.folded)))
    order, bits = _codes(best.folded)
    return Column(best.places, order, first + best.base * unit, unit, best.rise, bits)


def unpack(column: Column, count: int) -> list[int]:
    """Return the `count` numbers of a column.

    Raises `ValueError` if the column does not hold them.
    """
    if not count:
        return []
    if count > MOST or not EXACT <= column.order <= LONGEST:
        raise ValueError("a column of too many numbers, or of codes that there are not")
    left, places, rise = _numbers(column, count), column.places, column.rise
    if places == 0:
        units = [a + b for a, b in zip(left, _line(rise, count), strict=True)]
    elif places in PLACES:
        units = [0, *left[1:]]
        for n in range(1, count):
            units[n] += units[n - places] + rise if n >= places else units[n - 1]
    else:
        raise ValueError("a column of a kind that there is not")
    return [column.base + column.unit * n for n in units]


class _Try(NamedTuple):
    """Candidate prediction for a column."""

    places: int
    base: int
    rise: int
    folded: list[int]
    """Differences from the prediction, folded to non-negative integers."""


def _along(units: list[int], rise: int) -> _Try:
    left = [a - b for a, b in zip(units, _line(rise, len(units)), strict=True)] if rise else units
    middle = _median(left)
    return _Try(0, middle, rise, _folded([n - middle for n in left]))


def _from_before(units: list[int], places: int) -> _Try:
    """Predict each number from the one `places` before.

    The first `places` numbers are predicted from the number before each, without a step.
    """
    steps = [b - a for a, b in zip(units, units[places:], strict=False)]
    step = _median(steps)
    first = [0, *[b - a for a, b in pairwise(units[:places])]]
    return _Try(places, 0, step, _folded(first + [n - step for n in steps]))


def _median(values: Sequence[int]) -> int:
    return sorted(values)[len(values) // 2]


def _rise(values: Sequence[int]) -> int:
    """Return the total rise of the least-squares straight line through the values."""
    last = len(values) - 1
    return 6 * sum([(2 * n - last) * v for n, v in enumerate(values)]) // (last + 1) // (last + 2)


def _line(rise: int, count: int) -> list[int]:
    last = max(1, count - 1)
    return [rise * n // last for n in range(count)]


def _folded(values: list[int]) -> list[int]:
    """Fold signed integers 0, -1, 1, -2 ... to 0, 1, 2, 3 ..."""
    return [n << 1 if n >= 0 else ~(n << 1) for n in values]


def _codes(folded: list[int]) -> tuple[int, bytes]:
    """Return the order that gives the shortest codes, and the encoded bits."""
    if not any(folded):
        return EXACT, b""
    near = _median(folded).bit_length()
    order = min(range(max(0, near - 1), near + 2), key=lambda k: _length(folded, k))
    more = 1 << order
    code = {n: f"{n + more:0{2 * (n + more).bit_length() - order - 1}b}" for n in set(folded)}
    text = "1" + "".join([code[n] for n in folded])
    return order, int(text, 2).to_bytes((len(text) + 7) // 8)


def _length(folded: list[int], order: int) -> int:
    """Return the number of bits of all codes, plus one bit for each.

    The code of n has 2 * bit_length(n + 2**order) - order - 1 bits. The added bit is the same for
    every order, so it does not change which order is the best.
    """
    more = 1 << order
    return 2 * sum([(n + more).bit_length() for n in folded]) - order * len(folded)


def _numbers(column: Column, count: int) -> list[int]:
    order = column.order
    if order == EXACT:
        return [0] * count
    text = f"{int.from_bytes(column.bits):b}"
    at, more, found = 1, 1 << order, []
    for _ in range(count):
        begin = text.index("1", at)
        if begin - at > LONGEST:
            raise ValueError("a number of too many bits")
        at = 2 * begin - at + order + 1
        value = int(text[begin:at], 2) - more
        found.append(value >> 1 if value & 1 == 0 else ~(value >> 1))
    if at != len(text):
        raise ValueError("a column of another length")
    return found
