"""Estimates the sample times of a free-running board from the times at which its lines were read.

The board makes one line every T. The time of a read alone does not show to which of these slots a
line belongs: an adapter holds lines back, and during a host stall they wait in the kernel. Let a be
the time of a read, k the slot of its last line and c the time of slot 0. Then

    (1)  x = (a - c) / T - k        slots that the clock is ahead of the lines

is how late the read's last line is, and each missing line adds 1 to it.

If lines are read one by one, x is about 0, and a lone line shows at once how many are missing
before it. If an adapter batches lines, x lies between 0 and 1; then only a read counts that came no
later after the one before it than usual. Lines that a backlog certainly lacks are spread over its
lines. A line that comes before its slot takes back a slot that was counted in excess. Twice a
second the least x corrects c and T in a second-order loop:

    (2)  c += g x T                 (3)  T += g^2 / 2 x T / slots

Lines without a period are refused, and a clock that the lines contradict is given up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from statistics import fmean, median

from acsard.core.values import NS_PER_S

Read = tuple[int, int]
"""The time at which the last line of a read was complete, ns, and the number of its lines."""

WINDOW_NS, WINDOW_READS = NS_PER_S // 2, 12
"""Least duration and number of reads of a window from which a clock is found or corrected."""

GAIN = 0.2
"""Gain g of the settled loop. A window determines x to a few hundredths."""

DRIFT = 0.01
"""Relative error that a board's clock may have. A ceramic resonator has half of it."""

EXACT = 0.001
"""As DRIFT for periods that nobody has configured: a quartz's error and that of the fit."""

LONE = 0.7
"""Share of the reads with one line at which lines count as read one by one."""

LATE_ALONE, LATE_BATCHED = 0.6, 1.3
"""Largest lateness of a line in slots when a clock is found: for lines read one by one, for
batches."""

JUMP = 1.4
"""Slots since the last line. Below this a lone line cannot have another one missing before it."""

SURE = 0.15
"""Slots beyond the greatest possible lateness at which a line is certainly missing."""

EARLY = 0.25
"""Slots by which no line of a window may be early if the clock is right."""

MOST_LOST = 0.45
"""Share of the reads of two windows before which lines are missing. Above it the period is
wrong."""

BRIDGED_S = 1.0
"""Longest gap that is filled, s. After a longer one the board may have been reset."""


class Slots:
    """The slots of a free-running board, counted read by read."""

    def __init__(self, known: tuple[float, ...]) -> None:
        """Start; `known` are the configured periods, s."""
        self._known = known
        self.usual = 0.0
        """T in ns as last found, 0 before the first time."""
        self.found = 0
        """Number of the present clock. It rises whenever a clock is given up."""
        self._stretch = 1.0
        """Slots per line of the last read, including its share of the missing lines."""
        self._before = 0
        self._first, self._slot = 0.0, 0
        """c in ns, and k of the last line."""
        self._given = 0
        """Slots counted lately without a line. One of them may be taken back."""
        self._lag = self._batch = self._gain = self._share = 0.0
        """Usual x of a read, usual distance of two reads in slots, gain g, share of reads with
        missing lines."""
        self._batched: bool = False
        self._alone: bool = False
        """Whether an adapter batches lines, and whether the last line came alone."""
        self._least: float
        self._begin(0)
        self.forget()

    def forget(self) -> None:
        """Give up the clock, because the board has changed or keeps another period."""
        self.found += 1
        self.period: float | None = None
        """T in s as the firmware means it, None while unknown. The firmware divides its counts by
        this nominal period, whatever its clock does."""
        self._reads: list[Read] = []

    def read(self, at_ns: int, lines: int, drained: bool) -> int:
        """Return the number of missing lines before this read's last line, -1 for one too many.

        `at_ns` is when that line was complete. `drained` means that the kernel held no more data.
        """
        self._stretch = 1.0
        since, self._before = at_ns - self._before, at_ns
        if self.period is None:
            self._seek(at_ns, lines)
            return 0
        self._slot += lines
        ahead = (at_ns - self._first) / self.usual - self._slot
        lost = self._missing(ahead, since / self.usual, lines, drained)
        if lost < 0 and (self._given <= 0 or ahead > 0):
            self.forget()  # the lines come too early or ever later, so they follow another clock
            return 0
        self._slot += lost
        # What is missing for too long to be filled lies before the whole read.
        self._stretch = 1.0 + lost / lines if lost * self.usual < BRIDGED_S * NS_PER_S else 1.0
        self._given += lost
        self._passed += lines + lost
        self._lossy += lost > 0
        if lost <= 0:
            ahead -= lost
            self._least = min(self._least, ahead)
            if drained:
                self._lag += 0.03 * (min(max(ahead, 0.0), 1.0) - self._lag)
        if since < 1.5 * self._batch * self.usual:
            self._batch += 0.03 * (since / self.usual - self._batch)
        self._count += 1
        if self._count >= WINDOW_READS and at_ns - self._window_ns >= WINDOW_NS:
            self._follow(at_ns)
        return lost

    @property
    def late_ns(self) -> float:
        """Mean delay from the time at which a line is complete to its read, ns."""
        return self._lag * self.usual

    def time_ns(self, behind: int) -> int:
        """Return when a line was complete, ns, that lies `behind` lines before the last one."""
        return int(self._first + self.place(behind) * self.usual)

    def place(self, behind: int) -> float:
        """Return the slot of that line. Missing slots are spread over the lines of the read."""
        return self._slot - behind * self._stretch

    def _missing(self, ahead: float, since: float, lines: int, drained: bool) -> int:
        """Return how many slots this read proves missing, `since` slots after the last read.

        Return -1 if the read contradicts the clock.
        """
        lag = min(self._lag, 0.5)
        if ahead < -0.5 + 0.6 * lag:
            return -1
        if not drained:
            return 0
        alone, self._alone = self._alone, lines == 1
        if self._batched:
            prompt = since < 1.1 * self._batch and lines - 1 < since
            held = self._batch + 1.0  # an adapter holds the last line of a backlog back too
        else:
            held, prompt = 0.0, lines == 1
            if prompt and alone and since < JUMP:
                return -1 if ahead > 1 else 0  # the delay grew line by line, so no line is missing
        seen = ahead + 0.5 - 1.4 * lag if prompt else ahead - SURE - held
        return max(0, math.floor(seen))

    # Finding the clock and following it.

    def _seek(self, at_ns: int, lines: int) -> None:
        reads = self._reads
        reads.append((at_ns, lines))
        if len(reads) <= WINDOW_READS or at_ns - reads[0][0] < WINDOW_NS:
            return
        gaps = [after - before for (before, _), (after, _) in pairwise(reads)]
        for slots, most, guess in self._clocks(reads, gaps):
            first, late = _latest(reads, slots, guess)
            if max(late) <= most:
                break
        else:
            del reads[: len(reads) // 4]
            return
        self.usual, self._first, self._slot = guess, first, slots[-1]
        self._lag, self._batch, self._gain = fmean(late), median(gaps) / guess, 1.0
        self._batched = most > 1
        self._reads = []
        self.period = self._nominal()
        self._given, self._share, self._alone = 0, 0.0, False
        self._begin(at_ns)

    def _clocks(
        self, reads: list[Read], gaps: list[int]
    ) -> Iterator[tuple[list[int], float, float]]:
        """Yield candidate clocks, the likelier ones first.

        A candidate is the slot of each read's last line, the largest allowed lateness in slots, and
        the period in ns. The order has three reasons:

        - For jittery lines a configured period is more reliable than half a second of data.
        - An adapter hands lines over one by one too if they fill its packets. So the configured
          periods are tried without missing lines before any other period is tried with missing
          lines.
        - Half a second of batches cannot distinguish two periods that hardly differ.
        """
        plain, known = _slots(reads), [period * NS_PER_S for period in self._known]
        alone = [gap for gap, (_, lines) in zip(gaps, reads[1:], strict=True) if lines == 1]
        own = plain
        # Bytes that come faster than the wire can carry them have equal times, so the median may be
        # 0.
        if len(alone) >= LONE * len(gaps) and (usual := median(alone)) > 0:
            own = _slots(reads, usual)
            yield from ((own, LATE_ALONE, period) for period in known)
        yield from ((plain, LATE_BATCHED, period) for period in known)
        slope = _slope(reads, own)
        if slope <= 0:
            return
        if own is not plain:
            yield own, LATE_ALONE, slope
        elif all(abs(slope / period - 1) > DRIFT for period in known):
            yield own, LATE_BATCHED, slope

    def _begin(self, at_ns: int) -> None:
        """Start a window: its least x, its reads, their slots and the reads with missing lines."""
        self._window_ns: int = at_ns
        self._least = math.inf
        self._count: int = 0
        self._passed: int = 0
        self._lossy: int = 0

    def _follow(self, at_ns: int) -> None:
        """Correct c and T by equations (2) and (3).

        If the window contradicts the clock, give the clock up instead.
        """
        least, slots = self._least, self._passed
        lossy, self._share = self._share, self._lossy / self._count
        if (lossy + self._share) / 2 > MOST_LOST or least < -EARLY or least == math.inf:
            self.forget()
            return
        self._gain = max(GAIN, self._gain / (1 + self._gain))
        self._first += self._gain * least * self.usual
        usual = self.usual * (1 + self._gain**2 / 2 * least / slots)
        # The time of the present line stays unchanged.
        self._first -= (usual - self.usual) * self._slot
        self.usual = usual
        self.period = self._nominal()
        self._given = self._given if self._lossy else 0
        self._begin(at_ns)

    def _nominal(self) -> float:
        """Return the period that the firmware means.

        It is a configured period, a whole number of milliseconds, or the measured period.
        """
        seconds = self.usual / NS_PER_S
        for known in self._known:
            if abs(seconds / known - 1) < DRIFT:
                return known
        whole = max(1, round(seconds * 1000)) / 1000
        return whole if abs(seconds / whole - 1) < EXACT else seconds


def _slots(reads: list[Read], period: float = math.inf) -> list[int]:
    """Return the slot of each read's last line.

    A gap between reads adds missing lines if lines are `period` ns apart.
    """
    slots = [0]
    for (before, _), (at, lines) in pairwise(reads):
        slots.append(slots[-1] + max(lines, round((at - before) / period)))
    return slots


def _slope(reads: list[Read], slots: list[int]) -> float:
    """Return the period by least squares, ns."""
    origin = reads[0][0]
    times = [at - origin for at, _ in reads]
    middle, centre = fmean(slots), fmean(times)
    spread = math.fsum((slot - middle) ** 2 for slot in slots)
    rows = zip(slots, times, strict=True)
    return math.fsum((slot - middle) * (time - centre) for slot, time in rows) / spread


def _latest(reads: list[Read], slots: list[int], period: float) -> tuple[float, list[float]]:
    """Return the latest time of slot 0, ns, and each line's lateness in slots.

    The time is such that no line is early.
    """
    offsets = [at - slot * period for (at, _), slot in zip(reads, slots, strict=True)]
    first = min(offsets)
    return first, [(offset - first) / period for offset in offsets]
