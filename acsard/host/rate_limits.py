"""Limits rates with token buckets, and limits the number of simultaneous uses, such as connections.

A bucket with room for one unit enforces a shortest time between two units. This module reads no
clock: the caller passes the time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from acsard.core.values import NS_PER_S


class Rate(NamedTuple):
    """A permitted rate: `hz` units per second on average, in bursts of up to `burst` units."""

    hz: float
    burst: float = 1.0


class Bucket:
    """A token bucket that limits a rate. It is full at first.

    All times are monotonic times in ns.
    """

    def __init__(self, rate: Rate) -> None:
        self._unit_ns = round(NS_PER_S / rate.hz)
        self._burst_ns = round((rate.burst - 1.0) * self._unit_ns)
        self._full_at_ns = 0
        """Time at which the bucket is full again, ns. Taking a unit makes this time later by
        `_unit_ns`."""

    def room(self, now_ns: int) -> bool:
        """Return whether the bucket contains at least one unit now."""
        return self._full_at_ns <= now_ns + self._burst_ns

    def full(self, now_ns: int) -> bool:
        return self._full_at_ns <= now_ns

    def take(self, now_ns: int) -> bool:
        """Take one unit from the bucket and return True. Return False if the bucket is empty."""
        if not self.room(now_ns):
            return False
        self._full_at_ns = max(self._full_at_ns, now_ns) + self._unit_ns
        return True


class Buckets:
    """A token bucket for each name, and optionally a bucket that all names share."""

    def __init__(self, per_name: Rate, shared: Rate | None = None) -> None:
        """Create the buckets.

        `per_name` is the permitted rate of each name. `shared` is the permitted rate of all names
        together; None means that this rate is not limited.
        """
        self._per_name = per_name
        self._shared = None if shared is None else Bucket(shared)
        self._buckets: dict[str, Bucket] = {}

    def room(self, name: str, now_ns: int) -> bool:
        return name not in self._buckets or self._buckets[name].room(now_ns)

    def take(self, name: str, now_ns: int) -> bool:
        """Take a unit from the bucket of `name` and from the shared bucket, and return True.

        If either bucket is empty, take no unit and return False.
        """
        if name not in self._buckets:
            # Drop the full buckets, which equal new ones, so that many names do not fill the
            # memory.
            self._buckets = {
                k: bucket for k, bucket in self._buckets.items() if not bucket.full(now_ns)
            }
        own = self._buckets.setdefault(name, Bucket(self._per_name))
        if self._shared is None:
            return own.take(now_ns)
        # A name whose bucket is empty must not consume units of the shared bucket.
        return own.room(now_ns) and self._shared.take(now_ns) and own.take(now_ns)


class Places:
    """A limit on the number of simultaneous uses, such as connections. Each use takes a place.

    At most `most` places may be in use in total, and at most `per_name` of them for the same name.
    """

    def __init__(self, most: int, per_name: int) -> None:
        self._most, self._per_name = most, per_name
        self._counts: Counter[str] = Counter()

    @property
    def taken(self) -> int:
        return self._counts.total()

    def room(self, name: str) -> bool:
        return self._counts[name] < self._per_name and self.taken < self._most

    def enter(self, name: str) -> bool:
        """Take a place for `name` and return True. Return False if no place is free."""
        if not self.room(name):
            return False
        self._counts[name] += 1
        return True

    def leave(self, name: str) -> None:
        self._counts[name] -= 1
        if not self._counts[name]:
            del self._counts[name]

    @contextmanager
    def place(self, name: str = "") -> Iterator[bool]:
        """Take a place for `name` during a `with` block, and yield True.

        If no place is free, yield False.
        """
        free = self.enter(name)
        try:
            yield free
        finally:
            if free:
                self.leave(name)
