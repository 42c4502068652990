"""Limits rates with token buckets, and limits the number of simultaneous uses, such as connections.

A bucket with room for one unit enforces a shortest time between two units. This module reads no
clock: the caller passes the time.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from acsard.core.values import NS_PER_S, Ns


class Rate(NamedTuple):
    """A permitted rate: `hz` units per second on average, in bursts of up to `burst` units."""

    hz: float
    burst: float = 1.0


class Bucket:
    """A token bucket, full at first, that limits a rate."""

    def __init__(self, rate: Rate) -> None:
        self._unit_ns = round(NS_PER_S / rate.hz)
        self._burst_ns = round((rate.burst - 1.0) * self._unit_ns)
        self._full_at_ns = 0

    def room(self, now_ns: Ns) -> bool:
        """Return whether a unit can be taken."""
        return self._full_at_ns <= now_ns + self._burst_ns

    def full(self, now_ns: Ns) -> bool:
        return self._full_at_ns <= now_ns

    def take(self, now_ns: Ns) -> bool:
        """Take one unit; return False if there is none."""
        if not self.room(now_ns):
            return False
        self._full_at_ns = max(self._full_at_ns, now_ns) + self._unit_ns
        return True


class Buckets:
    """A token bucket for each name."""

    def __init__(self, per_name: Rate) -> None:
        self._per_name = per_name
        self._buckets: dict[str, Bucket] = {}

    def take(self, name: str, now_ns: Ns) -> bool:
        """Take a unit from the bucket of `name`; return False if there is none."""
        if name not in self._buckets:
            # Drop the full buckets, which equal new ones, so that many names do not fill the
            # memory.
            self._buckets = {
                k: bucket for k, bucket in self._buckets.items() if not bucket.full(now_ns)
            }
        return self._buckets.setdefault(name, Bucket(self._per_name)).take(now_ns)


class Places:
    """Limits the number of simultaneous uses, such as connections, in total and for each name."""

    def __init__(self, most: int, per_name: int) -> None:
        self._most, self._per_name = most, per_name
        self._counts: Counter[str] = Counter()

    @property
    def taken(self) -> int:
        return self._counts.total()

    def room(self, name: str) -> bool:
        return self._counts[name] < self._per_name and self.taken < self._most

    def enter(self, name: str) -> bool:
        """Take a place; return False if none is free."""
        if not self.room(name):
            return False
        self._counts[name] += 1
        return True

    def leave(self, name: str) -> None:
        self._counts[name] -= 1
        if not self._counts[name]:
            del self._counts[name]
