"""What the daemon measures of itself all the time: fixed memory, no clock of its own.

Each figure is a duration in us, told as median, 99th percentile and maximum since the start and
over the last minute. They go out in `state` and `diagnostics`.
"""

from __future__ import annotations

from collections import deque
from typing import Literal, get_args

from acsard.runtime.histogram import Histogram
from acsard.values import NS_PER_S, Measured

Name = Literal[
    "period_lateness",
    "step_time",
    "command_age",
    "command_to_wire",
    "feedback_to_bus",
    "mcu_round_trip",
]
"""The figures, in the order of the way a command goes:

period_lateness  from when a period was due to its step; of several missed ones, the first
step_time        from the start of a step to the end of its work
command_age      from a command's arrival here to each line that follows it
command_to_wire  from a command's arrival here to the line that first follows it, handed to the
                 port; one that first waited for its source's turn is not counted
feedback_to_bus  from the read of a feedback line's end to its messages left for the bus; before
                 that it may have waited in the kernel, for no longer than the loop stood still
mcu_round_trip   from a line to the end of its answer, where a checked reply tells which line it
                 answers; lines are pipelined, and nothing else does
"""

NAMES: tuple[Name, ...] = get_args(Name)

SLOT_NS = 10 * NS_PER_S
"""The last minute is kept in pieces of this length; the oldest makes room for the newest."""

SLOTS = 6

FRESH_NS = NS_PER_S
"""How old the cached values may be: adding up the minute costs more than a step."""


class _Figure:
    def __init__(self) -> None:
        self._past = Histogram()
        """All that is older than the last minute."""
        self._slots = [Histogram() for _ in range(SLOTS)]
        self._number = -SLOTS

    def add(self, now_ns: int, value: float) -> None:
        number = now_ns // SLOT_NS
        if number != self._number:
            self._advance(number)
        self._slots[number % SLOTS].add(value)

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
        self._number = number


class LastMinute:
    """How often something happened in the last minute, by the same pieces."""

    def __init__(self) -> None:
        self._slots: deque[tuple[int, int]] = deque(maxlen=SLOTS)

    def add(self, now_ns: int, count: int) -> None:
        """It happened so often at monotonic `now_ns`."""
        number, before = now_ns // SLOT_NS, 0
        if self._slots and self._slots[-1][0] == number:
            _, before = self._slots.pop()
        self._slots.append((number, before + count))

    def count(self, now_ns: int) -> int:
        """How often until monotonic `now_ns`."""
        oldest = now_ns // SLOT_NS - SLOTS
        return sum(count for number, count in self._slots if number > oldest)


class Figures:
    """All of them."""

    def __init__(self) -> None:
        self._figures = {name: _Figure() for name in NAMES}
        self._cached: dict[str, Measured] = {}
        self._cached_ns = -FRESH_NS

    def add(self, name: Name, now_ns: int, duration_ns: int) -> None:
        """Count one measurement made at monotonic `now_ns`."""
        self._figures[name].add(now_ns, duration_ns / 1000)

    def measured(self, now_ns: int) -> dict[str, Measured]:
        """Every figure by its name; at most a second old."""
        if now_ns - self._cached_ns >= FRESH_NS:
            self._cached_ns = now_ns
            self._cached = {name: figure.measured(now_ns) for name, figure in self._figures.items()}
        return self._cached
