"""Measures the daemon's latencies, in us, in fixed memory. The control loop supplies all times.

`state` and `diagnostics` have the median, the 99th percentile and the maximum of each, since the
start and over the last minute. A control step only appends raw numbers. They are sorted into
buckets when a client asks, and one latency every `TURN_NS`.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Collection
from functools import partial
from itertools import accumulate, cycle
from operator import add
from typing import Final, Literal, get_args

from acsard.core.messages.schema import Latency, Spread
from acsard.core.values import NS_PER_S, Ns

PER_DECADE = 20  # buckets: a percentile is at most 12 % too high

DECADES = 7  # from 1 us to 10 s; the outer buckets count what is beyond

LAST_BUCKET = PER_DECADE * DECADES

# The largest duration of each bucket but the last, ns.
EDGES_NS: Final = [int(1000 * math.pow(10.0, n / PER_DECADE)) for n in range(LAST_BUCKET)]

# A function of C: it takes 0.15 us for each of a thousand durations.
_bucket = partial(bisect_left, EDGES_NS)


class Histogram:
    """A histogram with logarithmic buckets, in memory that does not grow."""

    def __init__(self) -> None:
        self._buckets = [0] * (LAST_BUCKET + 1)
        self._max = 0.0

    def add(self, durations_ns: Collection[Ns]) -> None:
        if durations_ns:
            for index, count in Counter(map(_bucket, durations_ns)).items():
                self._buckets[index] += count
            self._max = max(self._max, max(durations_ns) / 1000)

    def merge(self, other: Histogram) -> None:
        self._buckets[:] = map(add, self._buckets, other._buckets)
        self._max = max(self._max, other._max)

    def spread(self) -> Spread:
        """Return the statistics; a percentile is rounded up to the end of its bucket."""
        totals = list(accumulate(self._buckets))
        p50, p99 = (self._percentile(totals, share) for share in (0.50, 0.99))
        return Spread(totals[-1], p50, p99, self._max)

    def _percentile(self, totals: list[int], share: float) -> float:
        rank = max(1.0, share * totals[-1])
        return min(math.pow(10.0, bisect_left(totals, rank) / PER_DECADE), self._max)


# period_lateness: from the due time of a period, or of the first missed one, to its step.
# step_time: of its work. command_age: from arrival to each line with the command; command_to_wire:
# to the first, unless it waited for its source. feedback_to_bus: from the read of a line until
# Zenoh has each of its messages. mcu_round_trip: from a line to its reply's end, only with
# `mcu.link_check`, as other replies do not name their line.
Name = Literal[
    "period_lateness",
    "step_time",
    "command_age",
    "command_to_wire",
    "feedback_to_bus",
    "mcu_round_trip",
]

NAMES: tuple[Name, ...] = get_args(Name)

SLOT_NS = 10 * NS_PER_S  # `SLOTS` of them are the last minute

SLOTS = 6

FRESH_NS = NS_PER_S  # for which statistics are cached: all slots take longer than a control step


TURN_NS = NS_PER_S // 4  # after which the raw durations of the next latency are sorted

MAX_RAW = 4096  # far more than come until it is the turn of the same latency again


class Figure:
    """The durations of one latency, since the start and over the last minute."""

    def __init__(self) -> None:
        self._raw: deque[Ns] = deque(maxlen=MAX_RAW)
        self.add = self._raw.append  # a duration, ns; any thread may call it
        self._past = Histogram()
        self._slots = [Histogram() for _ in range(SLOTS)]
        self._number = -SLOTS

    def measured(self, now_ns: Ns) -> Latency:
        self.sort(now_ns)
        minute = Histogram()
        for slot in self._slots:
            minute.merge(slot)
        last_minute = minute.spread()
        minute.merge(self._past)
        return Latency(minute.spread(), last_minute)

    def sort(self, now_ns: Ns) -> None:
        """Count the raw durations in the slot of this time."""
        number = now_ns // SLOT_NS
        for new in range(max(self._number, number - SLOTS) + 1, number + 1):
            self._past.merge(self._slots[new % SLOTS])
            self._slots[new % SLOTS] = Histogram()
        self._number = number
        raw = self._raw
        self._slots[number % SLOTS].add([raw.popleft() for _ in range(len(raw))])


class LastMinuteCount:
    """Counts events in the last minute, by slots."""

    def __init__(self) -> None:
        self._slots: deque[tuple[int, int]] = deque(maxlen=SLOTS)

    def add(self, now_ns: Ns, count: int) -> None:
        number, before = now_ns // SLOT_NS, 0
        if self._slots and self._slots[-1][0] == number:
            _, before = self._slots.pop()
        self._slots.append((number, before + count))

    def count(self, now_ns: Ns) -> int:
        oldest = now_ns // SLOT_NS - SLOTS
        return sum(count for number, count in self._slots if number > oldest)


class Stopwatch:
    def __init__(self) -> None:
        self.figures: dict[Name, Figure] = {name: Figure() for name in NAMES}
        self._missed = LastMinuteCount()
        self._cached: dict[str, Latency] = {}
        self._cached_ns = -FRESH_NS
        # Of a duration, ns: for latencies that a wake-up measures itself.
        self.step_time = self.figures["step_time"].add
        self.round_trip = self.figures["mcu_round_trip"].add
        self._turns, self._turn_ns = cycle(self.figures.values()), 0

    def measured(self, now_ns: Ns) -> dict[str, Latency]:
        """Return the statistics of each latency, us, at most 1 s old."""
        if now_ns - self._cached_ns >= FRESH_NS:
            self._cached_ns = now_ns
            self._cached = {name: figure.measured(now_ns) for name, figure in self.figures.items()}
        return self._cached

    def missed(self, now_ns: Ns) -> int:
        """Return how many control periods of the last minute got no step."""
        return self._missed.count(now_ns)

    def period(self, now_ns: Ns, late_ns: Ns, missed: int) -> None:
        """Record how late a step began after the first missed period, and how many were missed."""
        self.figures["period_lateness"].add(late_ns)
        if missed:
            self._missed.add(now_ns, missed)
        if now_ns >= self._turn_ns:
            self._turn_ns = now_ns + TURN_NS
            next(self._turns).sort(now_ns)  # takes about 40 us

    def line(self, command_ns: Ns | None, sent_ns: Ns, before_ns: Ns, changed: bool) -> None:
        """Record how old the command in a line was when it was written, while the robot drives.

        `changed`: the speed to follow or the mode is another one than in the line at `before_ns`.
        """
        if command_ns is None:
            return
        self.figures["command_age"].add(sent_ns - command_ns)
        # A command that is older than the previous line was in that line already, or it had to wait
        # until its source was chosen.
        if changed and command_ns > before_ns:
            self.figures["command_to_wire"].add(sent_ns - command_ns)
