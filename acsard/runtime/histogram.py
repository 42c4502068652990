"""Percentiles of an endless stream in fixed memory, by logarithmic buckets."""

from __future__ import annotations

import math
from bisect import bisect_left
from itertools import accumulate
from operator import add

from acsard.values import Spread

PER_DECADE = 20
"""Buckets per factor of ten. A percentile is accurate to 12 %."""

DECADES = 7
"""Range from 1 to 10^7 of the unit. Values outside it fall into the end buckets."""

LAST = PER_DECADE * DECADES
"""Index of the end bucket."""


ENDS = [math.pow(10.0, index / PER_DECADE) for index in range(LAST)]
"""The upper end of each bucket except the last, which is open."""


class Histogram:
    """Measurements of one quantity, counted in buckets."""

    def __init__(self) -> None:
        self._buckets = [0] * (LAST + 1)
        self._count = 0
        self._max = 0.0

    def add(self, value: float) -> None:
        """Count a measurement."""
        self._buckets[bisect_left(ENDS, value)] += 1
        self._count += 1
        if value > self._max:
            self._max = value

    def merge(self, other: Histogram) -> None:
        """Add all measurements of another histogram."""
        if other._count == 0:
            return
        self._buckets[:] = map(add, self._buckets, other._buckets)
        self._count += other._count
        self._max = max(self._max, other._max)

    def spread(self) -> Spread:
        """Return median, 99th percentile and maximum.

        A percentile is the upper end of its bucket.
        """
        return Spread(self._count, self._percentile(0.50), self._percentile(0.99), self._max)

    def _percentile(self, share: float) -> float:
        if self._count == 0:
            return 0.0
        rank = max(1.0, share * self._count)
        index = bisect_left(list(accumulate(self._buckets)), rank)
        return min(math.pow(10.0, index / PER_DECADE), self._max)
