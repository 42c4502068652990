"""Whole numbers of one kind -> few bits, and back.

Of each number a column keeps how far it is from where it is expected: on a straight line, or a step
on from the number before, or from the one eight places before. That is told in units of what
divides all of them: near ones in few bits, whatever their sign, far ones in as many as they need.
What is the shortest is seen by trying.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from msgspec import Struct

PLACES = (1, 8)
"""How far back the number may be that another is expected from. What does several things in turn,
as the simulated microcontroller does eight, takes a time of its own for each."""

EXACT = -1
"""In place of an order: all are exactly where they are expected, and nothing is left to tell."""

MOST = 1 << 16
"""Numbers in a column: those that are exact take no room, so a damaged count could ask for any."""

LONGEST = 64
"""Bits of a number at most."""


class Column(Struct, frozen=True, array_like=True):
    """Numbers; their count is told elsewhere."""

    places: int = 0
    """From which number before; 0 is along a line."""
    order: int = EXACT
    """Of the codes (exponential Golomb): so many bits have those that are near."""
    base: int = 0
    """Where the line begins; else the first number."""
    unit: int = 1
    rise: int = 0
    """In units: of the line, from the first number to the last; else of the step."""
    bits: bytes = b""
    """The highest bit that is set comes before the first code."""


EMPTY = Column()


def pack(values: Sequence[int]) -> Column:
    """The shortest column of `values`, each of at most 62 bits."""
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
    """The `count` numbers again; raises `ValueError` when they do not fit."""
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
    """A way to tell numbers."""

    places: int
    base: int
    rise: int
    folded: list[int]
    """What is left to tell."""


def _along(units: list[int], rise: int) -> _Try:
    left = [a - b for a, b in zip(units, _line(rise, len(units)), strict=True)] if rise else units
    middle = _median(left)
    return _Try(0, middle, rise, _folded([n - middle for n in left]))


def _from_before(units: list[int], places: int) -> _Try:
    """The first ones are told from the one before, without a step."""
    steps = [b - a for a, b in zip(units, units[places:], strict=False)]
    step = _median(steps)
    first = [0, *[b - a for a, b in pairwise(units[:places])]]
    return _Try(places, 0, step, _folded(first + [n - step for n in steps]))


def _median(values: Sequence[int]) -> int:
    return sorted(values)[len(values) // 2]


def _rise(values: Sequence[int]) -> int:
    """Of the straight line with the least squares, from the first to the last."""
    last = len(values) - 1
    return 6 * sum([(2 * n - last) * v for n, v in enumerate(values)]) // (last + 1) // (last + 2)


def _line(rise: int, count: int) -> list[int]:
    last = max(1, count - 1)
    return [rise * n // last for n in range(count)]


def _folded(values: list[int]) -> list[int]:
    """0, -1, 1, -2 ... as 0, 1, 2, 3 ..."""
    return [n << 1 if n >= 0 else ~(n << 1) for n in values]


def _codes(folded: list[int]) -> tuple[int, bytes]:
    """The order that makes them short, and the bits."""
    if not any(folded):
        return EXACT, b""
    near = _median(folded).bit_length()
    order = min(range(max(0, near - 1), near + 2), key=lambda k: _length(folded, k))
    more = 1 << order
    code = {n: f"{n + more:0{2 * (n + more).bit_length() - order - 1}b}" for n in set(folded)}
    text = "1" + "".join([code[n] for n in folded])
    return order, int(text, 2).to_bytes((len(text) + 7) // 8)


def _length(folded: list[int], order: int) -> int:
    """Half of the bits that vary: each number takes twice its own length, less the order."""
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
