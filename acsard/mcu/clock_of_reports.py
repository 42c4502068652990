"""The clock of an MCU that reports by itself, found from when its lines were read.

It makes one line every T; which of these slots a line belongs to, the time of its read does not
tell by itself: an adapter holds lines back, and while the host stalls they lie in the kernel. With
a the time of a read, k the lines until then and c the time of slot 0,

    (1)  x = (a - c) / T - k        slots that the clock is ahead of the lines

is how late the read's last line is, and lines that are missing make it larger by whole numbers.
Read one by one as they come, x is about 0: a lone line shows at once how many are missing before
it. An adapter that hands lines over in batches makes x anything from 0 to 1: then a read counts
that came no later after the one before it than usual. What a backlog is short of for certain is
spread over its lines. A line that comes before its slot takes a slot back that was counted too
many. Twice a second the least x moves c and T, a second-order loop:

    (2)  c += g x T                 (3)  T += g^2 / 2 x T / slots

Lines that keep no period are refused, and a clock that they contradict is given up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from statistics import fmean, median

from acsard.values import NS_PER_S

Read = tuple[int, int]
"""When the last line of a read was complete, ns, and how many lines it had."""

WINDOW_NS, WINDOW_READS = NS_PER_S // 2, 12
"""What a clock is found from, and followed by."""

GAIN = 0.2
"""Of the loop when it has settled: x of a window is known to a few hundredths."""

DRIFT = 0.01
"""By which share an MCU's clock may be off; a ceramic resonator has half of it."""

EXACT = 0.001
"""As DRIFT, for periods that nobody has configured: a quartz, and what the fit is off."""

LONE = 0.7
"""Share of the reads that have one line, from which on they are read one by one."""

LATE_ALONE, LATE_BATCHED = 0.6, 1.3
"""How late in slots any line may be of those a clock is found from: read one by one, or not."""

JUMP = 1.4
"""Slots since the last line, from which on a lone one can have lost another before it."""

SURE = 0.15
"""Slots beyond the latest that a line can be, from which on one is missing for certain."""

EARLY = 0.25
"""Slots by which no line of a window may be ahead of a clock that is right."""

MOST_LOST = 0.45
"""Share of two windows' reads that lines are missing before; more, and it is another period."""


class Slots:
    """Counts slots read by read; `period` is None while no clock is known."""

    def __init__(self, known: tuple[float, ...]) -> None:
        """`known` are the periods in s that the configuration speaks of."""
        self._known = known
        self.usual = 0.0
        """T in ns as last found, 0 before."""
        self.found = 0
        """Which of all clocks it is that is known."""
        self._stretch = 1.0
        """Slots that each line of the last read has, its share of the missing ones with it."""
        self._before = 0
        self._first, self._slot = 0.0, 0
        """c in ns, and k of the last line."""
        self._given = 0
        """Slots counted of late that no line came for: one of them may be taken back."""
        self._lag = self._batch = self._gain = self._share = 0.0
        """Usual x of a read and its distance from the last, in slots; g; the lossy reads' share."""
        self._batched: bool = False
        self._alone: bool = False
        """Lines come several in a read; the last one came alone."""
        self._least: float
        self._begin(0)
        self.forget()

    def forget(self) -> None:
        """The clock is another one now, or none."""
        self.found += 1
        self.period: float | None = None
        """T in s as the MCU means it: it divides its counts by that, whatever its clock does."""
        self._reads: list[Read] = []

    def read(self, at_ns: int, lines: int, drained: bool) -> int:
        """The slots that nothing came of before this read's last line, -1 for one too many.

        `at_ns` is when that line was complete, `drained` that no more lay in the kernel.
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
            self.forget()  # no line comes before its time, or ever later: it is not this clock's
            return 0
        self._slot += lost
        self._stretch = 1.0 + lost / lines
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
        """How long after its line was complete a read comes, in the mean."""
        return self._lag * self.usual

    def time_ns(self, behind: int) -> int:
        """When the line was complete that lies so many lines before the read's last one."""
        return int(self._first + (self._slot - behind) * self.usual)

    def place(self, behind: int) -> float:
        """The slot of that line; those that are missing are spread over the lines of the read."""
        return self._slot - behind * self._stretch

    def _missing(self, ahead: float, since: float, lines: int, drained: bool) -> int:
        """How many slots are missing, as far as this read can tell, `since` slots after the last.

        -1 where the clock contradicts it.
        """
        lag = min(self._lag, 0.5)
        if ahead < -0.5 + 0.6 * lag:
            return -1
        if not drained:
            return 0
        alone, self._alone = self._alone, lines == 1
        if self._batched:
            prompt = since < 1.1 * self._batch and lines - 1 < since
            held = self._batch + 1.0  # an adapter goes on holding the last line of a backlog
        else:
            held, prompt = 0.0, lines == 1
            if prompt and alone and since < JUMP:
                return -1 if ahead > 1 else 0  # it only grew later, line by line
        seen = ahead + 0.5 - 1.4 * lag if prompt else ahead - SURE - held
        return max(0, math.floor(seen))

    # finding the clock, and following it

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
        """What may be the clock, the likelier ones first: the slot of each read's last line, how
        late in slots one may be, and the period in ns.

        Of jittery lines a configured period says more than half a second of them. An adapter hands
        lines over one by one too, where they fill its packets: so before lines are missing for a
        period that nobody has configured, none is for one that somebody has. And half a second of
        batches tells no period from one that it is hardly off.
        """
        plain, known = _slots(reads), [period * NS_PER_S for period in self._known]
        alone = [gap for gap, (_, lines) in zip(gaps, reads[1:], strict=True) if lines == 1]
        own = plain
        # Bytes that come faster than the wire can carry them have times that are one and the same.
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
        """A new window: its least x, its reads, their slots, and how many of them were lossy."""
        self._window_ns: int = at_ns
        self._least = math.inf
        self._count: int = 0
        self._passed: int = 0
        self._lossy: int = 0

    def _follow(self, at_ns: int) -> None:
        """Equations (2) and (3), with what the window showed."""
        least, slots = self._least, self._passed
        lossy, self._share = self._share, self._lossy / self._count
        if (lossy + self._share) / 2 > MOST_LOST or least < -EARLY or least == math.inf:
            self.forget()
            return
        self._gain = max(GAIN, self._gain / (1 + self._gain))
        self._first += self._gain * least * self.usual
        usual = self.usual * (1 + self._gain**2 / 2 * least / slots)
        self._first -= (usual - self.usual) * self._slot  # the line now stays where it is
        self.usual = usual
        self.period = self._nominal()
        self._given = self._given if self._lossy else 0
        self._begin(at_ns)

    def _nominal(self) -> float:
        """The period the firmware means: a configured one, whole milliseconds, or as measured."""
        seconds = self.usual / NS_PER_S
        for known in self._known:
            if abs(seconds / known - 1) < DRIFT:
                return known
        whole = max(1, round(seconds * 1000)) / 1000
        return whole if abs(seconds / whole - 1) < EXACT else seconds


def _slots(reads: list[Read], period: float = math.inf) -> list[int]:
    """The slot of each read's last line, with those that are missing if it were this period, ns."""
    slots = [0]
    for (before, _), (at, lines) in pairwise(reads):
        slots.append(slots[-1] + max(lines, round((at - before) / period)))
    return slots


def _slope(reads: list[Read], slots: list[int]) -> float:
    """The period by least squares, ns."""
    origin = reads[0][0]
    times = [at - origin for at, _ in reads]
    middle, centre = fmean(slots), fmean(times)
    spread = math.fsum((slot - middle) ** 2 for slot in slots)
    rows = zip(slots, times, strict=True)
    return math.fsum((slot - middle) * (time - centre) for slot, time in rows) / spread


def _latest(reads: list[Read], slots: list[int], period: float) -> tuple[float, list[float]]:
    """The time of slot 0, ns, with no line early; and by how many slots each is late."""
    offsets = [at - slot * period for (at, _), slot in zip(reads, slots, strict=True)]
    first = min(offsets)
    return first, [(offset - first) / period for offset in offsets]
