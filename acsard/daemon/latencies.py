"""Measures the daemon's own latencies, in fixed memory and without a clock of its own.

Each figure is a duration in us, published as median, 99th percentile and maximum, since the start
and over the last minute. The messages `state` and `diagnostics` carry them. `Stopwatch` takes the
times from the control loop.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from itertools import accumulate
from operator import add
from typing import Literal, get_args

from acsard.core.values import NS_PER_S, Estimate, Measured, Outputs, Spread

PER_DECADE = 20
"""Buckets per factor of ten. A percentile is accurate to 12 %."""

DECADES = 7
"""Range from 1 to 10^7 of the unit. Values outside it fall into the end buckets."""

LAST = PER_DECADE * DECADES
"""Index of the end bucket."""


class Histogram:
    """Percentiles of an endless stream in fixed memory, by logarithmic buckets."""

    def __init__(self) -> None:
        self._buckets = [0] * (LAST + 1)
        self._max = 0.0

    def add(self, value: float) -> None:
        """Count a measurement."""
        # A search in a table of the buckets' ends would fetch a dozen cold cache lines each time.
        index = math.ceil(PER_DECADE * math.log10(value)) if value > 1.0 else 0
        self._buckets[index if index < LAST else LAST] += 1
        if value > self._max:
            self._max = value

    def merge(self, other: Histogram) -> None:
        """Add all measurements of another histogram."""
        self._buckets[:] = map(add, self._buckets, other._buckets)
        self._max = max(self._max, other._max)

    def spread(self) -> Spread:
        """Return median, 99th percentile and maximum.

        A percentile is the upper end of its bucket.
        """
        totals = list(accumulate(self._buckets))
        p50, p99 = (self._percentile(totals, share) for share in (0.50, 0.99))
        return Spread(totals[-1], p50, p99, self._max)

    def _percentile(self, totals: list[int], share: float) -> float:
        rank = max(1.0, share * totals[-1])
        return min(math.pow(10.0, bisect_left(totals, rank) / PER_DECADE), self._max)


Name = Literal[
    "period_lateness",
    "step_time",
    "command_age",
    "command_to_wire",
    "feedback_to_bus",
    "mcu_round_trip",
]
"""The figures, in the order in which a command passes them.

- period_lateness: from the time at which a period was due to its step; of several missed periods,
  the first one counts
- step_time: from the start of a step to the end of its work
- command_age: from a command's arrival to each line that carries it
- command_to_wire: from a command's arrival to the moment when the port took the first line that
  carries it; a command that first waited for its source's turn is not counted
- feedback_to_bus: from the read of a feedback line's end to its messages in the queue of the bus;
  before the read the line may have waited in the kernel while the loop stood still
- mcu_round_trip: from the leaving of a line to the end of its answer, only for checked replies,
  because only these tell which of the pipelined lines they answer
"""

NAMES: tuple[Name, ...] = get_args(Name)

SLOT_NS = 10 * NS_PER_S
"""Length of a slot of the last minute. The newest slot replaces the oldest."""

SLOTS = 6

FRESH_NS = NS_PER_S
"""Longest age of the cached values. Adding up a minute costs more than a control step."""


class Figure:
    """One latency since the start and over the last minute."""

    def __init__(self) -> None:
        self._past = Histogram()
        """All measurements older than the last minute."""
        self._slots = [Histogram() for _ in range(SLOTS)]
        self._number = -SLOTS
        self._slot, self._ends_ns = self._slots[0], 0
        """The newest slot, and the monotonic time at which it ends."""

    def add(self, now_ns: int, duration_ns: int) -> None:
        """Record a duration that was measured at monotonic `now_ns`."""
        if now_ns >= self._ends_ns:
            self._advance(now_ns // SLOT_NS)
        self._slot.add(duration_ns / 1000)

    def measured(self, now_ns: int) -> Measured:
        """Return the percentiles at monotonic `now_ns`."""
        self._advance(now_ns // SLOT_NS)
        minute = Histogram()
        for slot in self._slots:
            minute.merge(slot)
        last_minute = minute.spread()
        minute.merge(self._past)
        return Measured(minute.spread(), last_minute)

    def _advance(self, number: int) -> None:
        for new in range(max(self._number, number - SLOTS) + 1, number + 1):
            self._past.merge(self._slots[new % SLOTS])
            self._slots[new % SLOTS] = Histogram()
        # A measurement may be a little older than the one before it.
        number = self._number = max(number, self._number)
        self._slot, self._ends_ns = self._slots[number % SLOTS], (number + 1) * SLOT_NS


class LastMinute:
    """A counter of events in the last minute, to the 10 s of a slot."""

    def __init__(self) -> None:
        self._slots: deque[tuple[int, int]] = deque(maxlen=SLOTS)

    def add(self, now_ns: int, count: int) -> None:
        """Count `count` events at monotonic `now_ns`."""
        number, before = now_ns // SLOT_NS, 0
        if self._slots and self._slots[-1][0] == number:
            _, before = self._slots.pop()
        self._slots.append((number, before + count))

    def count(self, now_ns: int) -> int:
        """Return the number of events in the minute before monotonic `now_ns`."""
        oldest = now_ns // SLOT_NS - SLOTS
        return sum(count for number, count in self._slots if number > oldest)


class Stopwatch:
    """The measurements of the control loop."""

    def __init__(self) -> None:
        self.figures: dict[Name, Figure] = {name: Figure() for name in NAMES}
        self._missed = LastMinute()
        self._cached: dict[str, Measured] = {}
        self._cached_ns = -FRESH_NS

    def measured(self, now_ns: int) -> dict[str, Measured]:
        """Return all figures by name, at most a second old."""
        if now_ns - self._cached_ns >= FRESH_NS:
            self._cached_ns = now_ns
            self._cached = {name: figure.measured(now_ns) for name, figure in self.figures.items()}
        return self._cached

    def missed(self, now_ns: int) -> int:
        """Return the number of periods in the last minute that had no step."""
        return self._missed.count(now_ns)

    def period(self, now_ns: int, late_ns: int, missed: int = 0) -> None:
        """Record a period's step, `late_ns` late after `missed` periods without one."""
        self.figures["period_lateness"].add(now_ns, late_ns)
        if missed:
            self._missed.add(now_ns, missed)

    def line(self, outputs: Outputs, sent_ns: int, before_ns: int) -> None:
        """Record the age of a sent line's command; the line before left at `before_ns`."""
        command_ns = outputs.command_ns
        if command_ns is None or outputs.mode != "driving":
            return
        self.figures["command_age"].add(sent_ns, sent_ns - command_ns)
        if command_ns > before_ns:  # otherwise it waited for its source's turn, not for the wire
            self.figures["command_to_wire"].add(sent_ns, sent_ns - command_ns)

    def feedback(self, estimate: Estimate, told_ns: int | None) -> None:
        """Record the delays of a feedback line.

        `told_ns` is the time at which its messages were queued for the bus, or None if no client
        subscribes to them.
        """
        at_ns, asked_ns = estimate.heard_ns, estimate.asked_ns
        if asked_ns is not None:
            self.figures["mcu_round_trip"].add(at_ns, at_ns - asked_ns)
        if told_ns is not None:
            self.figures["feedback_to_bus"].add(told_ns, told_ns - at_ns)

    def step(self, began_ns: int, ended_ns: int) -> None:
        """Record the start and the end of a step."""
        self.figures["step_time"].add(began_ns, ended_ns - began_ns)
