"""Measures the daemon's latencies, in us, in fixed memory. The control loop supplies all times.

The messages `state` and `diagnostics` contain the median, the 99th percentile and the maximum of
each latency, once since the daemon's start and once over the last minute.
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
"""Number of histogram buckets for each factor of ten. With this number, a percentile is at most 12
% too high."""

DECADES = 7
"""Number of factors of ten that the buckets of a histogram cover: from 1 us to 10 s. The first
bucket also counts shorter durations, and the last bucket also counts longer ones."""

LAST_BUCKET = PER_DECADE * DECADES
"""Index of the last bucket of a histogram."""


class Histogram:
    """A histogram with logarithmic buckets, for the percentiles of any number of values.

    Its memory does not grow with the number of values.
    """

    def __init__(self) -> None:
        self._buckets = [0] * (LAST_BUCKET + 1)
        self._max = 0.0

    def add(self, value: float) -> None:
        # Compute the index, because a search in a table would fetch a dozen cold cache lines.
        index = math.ceil(PER_DECADE * math.log10(value)) if value > 1.0 else 0
        self._buckets[index if index < LAST_BUCKET else LAST_BUCKET] += 1
        if value > self._max:
            self._max = value

    def merge(self, other: Histogram) -> None:
        self._buckets[:] = map(add, self._buckets, other._buckets)
        self._max = max(self._max, other._max)

    def spread(self) -> Spread:
        """Return the median, the 99th percentile and the maximum of all values.

        A percentile is rounded up to the upper end of its bucket, but not above the maximum.
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
"""The latencies that the daemon measures. A line is a line of text to or from the board.

- period_lateness: from the due time of a control period to the start of its step. If periods were
  missed, from the due time of the first missed period.
- step_time: from the start of a control step to the end of its work.
- command_age: from a command's arrival to the write of each line that carries it.
- command_to_wire: from a command's arrival to the write of the first line that carries it. A
  command that had to wait until its source was chosen is not counted.
- feedback_to_bus: from the read of a complete feedback line to the moment at which its messages are
  queued for the bus. The line's wait in the kernel before the read is not included.
- mcu_round_trip: from the write of a line to the read of the end of its reply. It is measured only
  with `mcu.link_check`, because a reply otherwise does not name the line it answers."""

NAMES: tuple[Name, ...] = get_args(Name)

SLOT_NS = 10 * NS_PER_S
"""Length of a time slot, ns. The last `SLOTS` slots together are the last minute."""

SLOTS = 6

FRESH_NS = NS_PER_S
"""Age up to which `Stopwatch.measured` returns cached statistics, ns. They are cached because
computing them, over all time slots of the last minute, takes longer than a control step."""


class Figure:
    """The measured values of one latency, since the daemon's start and over the last minute."""

    def __init__(self) -> None:
        self._past = Histogram()
        self._slots = [Histogram() for _ in range(SLOTS)]
        self._number = -SLOTS
        self._slot, self._ends_ns = self._slots[0], 0
        """`_slot` is the histogram of the newest time slot. `_ends_ns` is the monotonic time at
        which this slot ends, ns."""

    def add(self, now_ns: int, duration_ns: int) -> None:
        if now_ns >= self._ends_ns:
            self._advance(now_ns // SLOT_NS)
        self._slot.add(duration_ns / 1000)

    def measured(self, now_ns: int) -> Measured:
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


class LastMinuteCount:
    """A counter of the events in the last minute, with a resolution of one slot (10 s)."""

    def __init__(self) -> None:
        self._slots: deque[tuple[int, int]] = deque(maxlen=SLOTS)

    def add(self, now_ns: int, count: int) -> None:
        number, before = now_ns // SLOT_NS, 0
        if self._slots and self._slots[-1][0] == number:
            _, before = self._slots.pop()
        self._slots.append((number, before + count))

    def count(self, now_ns: int) -> int:
        oldest = now_ns // SLOT_NS - SLOTS
        return sum(count for number, count in self._slots if number > oldest)


class Stopwatch:
    """The latency measurements of the control loop."""

    def __init__(self) -> None:
        self.figures: dict[Name, Figure] = {name: Figure() for name in NAMES}
        self._missed = LastMinuteCount()
        self._cached: dict[str, Measured] = {}
        self._cached_ns = -FRESH_NS

    def measured(self, now_ns: int) -> dict[str, Measured]:
        """Return the statistics of each latency, us, by the name of the latency.

        They are at most 1 s old. `now_ns` is the present monotonic time, ns.
        """
        if now_ns - self._cached_ns >= FRESH_NS:
            self._cached_ns = now_ns
            self._cached = {name: figure.measured(now_ns) for name, figure in self.figures.items()}
        return self._cached

    def missed(self, now_ns: int) -> int:
        """Return how many control periods got no control step in the last minute.

        `now_ns` is the present monotonic time, ns.
        """
        return self._missed.count(now_ns)

    def period(self, now_ns: int, late_ns: int, missed: int) -> None:
        """Record how late a step began, and how many periods were missed before this step.

        Args:
            now_ns: monotonic time at which the step began, ns.
            late_ns: time from the due time of this period to `now_ns`, ns. If periods were missed,
                the time is measured from the due time of the first missed period.
            missed: number of periods just before this one that got no step.
        """
        self.figures["period_lateness"].add(now_ns, late_ns)
        if missed:
            self._missed.add(now_ns, missed)

    def line(self, outputs: Outputs, sent_ns: int, before_ns: int) -> None:
        """Record how old the command in a line to the board was when the line was written.

        Record nothing if the robot does not drive.

        Args:
            outputs: the outputs of the step that made the line.
            sent_ns: monotonic time at which the line was written, ns.
            before_ns: monotonic time at which the previous line was written, ns.
        """
        command_ns = outputs.command_ns
        if command_ns is None or outputs.mode != "driving":
            return
        self.figures["command_age"].add(sent_ns, sent_ns - command_ns)
        # A command that is older than the previous line was in that line already, or it had to wait
        # until its source was chosen.
        if command_ns > before_ns:
            self.figures["command_to_wire"].add(sent_ns, sent_ns - command_ns)

    def feedback(self, estimate: Estimate, queued_ns: int | None) -> None:
        """Record the latencies `mcu_round_trip` and `feedback_to_bus` of a feedback line.

        Args:
            estimate: the estimate that was computed from the feedback line.
            queued_ns: monotonic time at which the messages of the line were queued for the bus, ns.
                None if no client subscribes to these messages, so that only the round trip is
                recorded.
        """
        at_ns, asked_ns = estimate.heard_ns, estimate.asked_ns
        if asked_ns is not None:
            self.figures["mcu_round_trip"].add(at_ns, at_ns - asked_ns)
        if queued_ns is not None:
            self.figures["feedback_to_bus"].add(queued_ns, queued_ns - at_ns)
