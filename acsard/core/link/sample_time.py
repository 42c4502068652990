"""Estimates when the board took its samples, by one clock for each of two kinds of boards.

The time at which the host reads a line is not the time of its sample: an adapter, the scheduler or
a stall of the host may have held the line back. `FreeRunningTimes` finds the period of a board that
reports by its own clock. `PromptedTimes` takes the lines that left as the clock of a board that
answers each of them. Both take each read by `read` and return the time of each of its lines by
`place`, as a `Placed`. `forget` starts a new session. `feedback.py` chooses the better clock for
each line.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from itertools import pairwise
from statistics import fmean, median
from typing import Literal

from msgspec import Struct

from acsard.core.values import NS_PER_S

Read = tuple[int, int]
"""The time at which the last line of a read was complete, ns, and the number of its lines."""

BRIDGED_S = 1.0
"""Longest gap that is filled, s. After a longer one the board may have been reset."""


class Placed(Struct, frozen=True, gc=False):
    """The time of a line by one of the clocks; `due_ns` is when it was due to be complete here."""

    clock: Literal["slots", "prompts", "reads"]
    due_ns: int
    dt: float | None = None
    """Seconds since the last line by the same clock, None for the first line."""
    bridged: float = 0.0
    """Seconds of `dt` that no line reported."""
    early: bool = False
    """Whether the line came before it was due. Then `due_ns` is its arrival, and the time to the
    next line is the difference of their `due_ns`."""


# A free-running board.

WINDOW_NS, WINDOW_READS = NS_PER_S // 2, 12
"""Least duration and number of reads of a window from which a clock is found or corrected."""

LOOP_GAIN = 0.2
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

EARLY_ALONE = 0.5
"""Slots by which one line may be earlier than all others when a clock is found. A line that is
earlier came out of turn: it answers a command that left between two periods. With it as the
earliest line, all others would be a slot late."""

JUMP = 1.4
"""Slots since the last line. Below this a lone line cannot have another one missing before it."""

SURE = 0.15
"""Slots beyond the greatest possible lateness at which a line is certainly missing."""

EARLY = 0.25
"""Slots by which no line of a window may be early if the clock is right."""

LOSSY_READS = 0.45
"""Share of the reads of two windows before which lines are missing. Above it the period is
wrong."""


class FreeRunningTimes:
    """The sample times of a free-running board, from the times at which its lines were read.

    The board makes one line every T. The time of a read alone does not show to which of these slots
    a line belongs: an adapter holds lines back, and during a host stall they wait in the kernel.
    Let a be the time of a read, k the slot of its last line and c the time of slot 0. Then

        (1)  x = (a - c) / T - k        slots that the clock is ahead of the lines

    is how late the read's last line is, and each missing line adds 1 to it.

    If lines are read one by one, x is about 0, and a lone line shows at once how many are missing
    before it. If an adapter batches lines, x lies between 0 and 1; then only a read counts that
    came no later after the one before it than usual. Lines that a backlog certainly lacks are
    spread over its lines. A line that comes before its slot takes back a slot that was counted in
    excess. Twice a second the least x corrects c and T in a second-order loop:

        (2)  c += g x T                 (3)  T += g^2 / 2 x T / slots

    Lines without a period are refused, and a clock that the lines contradict is given up.
    """

    def __init__(self, known: tuple[float, ...]) -> None:
        """Start; `known` are the configured periods, s."""
        self._known = known
        self.usual = 0.0
        """T in ns as last found, 0 before the first time."""
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
        self.period: float | None = None
        """T in s as the firmware means it, None while unknown. The firmware divides its counts by
        this nominal period, whatever its clock does."""
        self._reads: list[Read] = []
        self._last: float | None = None
        """Slot of the last placed line, None before the first one by the present clock."""

    def read(self, at_ns: int, lines: int, drained: bool) -> int:
        """Return the number of lines that were lost before the last line of this read.

        The result is -1 if there was one line too many. `at_ns` is the time at which the last line
        was complete. `drained` means that the kernel held no more data.
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

    def place(self, behind: int) -> Placed | None:
        """Return the time of the line that lies `behind` lines before the last one of the read.

        Missing slots are spread over the lines of the read. Return None while no clock is known.
        """
        period, last = self.period, self._last
        if period is None:
            return None
        slot = self._last = self._slot - behind * self._stretch
        due_ns = int(self._first + slot * self.usual)
        if last is None:
            return Placed("slots", due_ns)
        passed = slot - last if slot > last else 0.0
        missing = passed - 1.0 if passed > 1.0 else 0.0
        return Placed("slots", due_ns, passed * period, missing * period)

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
            if max(late) <= most and sorted(late)[1] <= EARLY_ALONE:
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
        if (lossy + self._share) / 2 > LOSSY_READS or least < -EARLY or least == math.inf:
            self.forget()
            return
        self._gain = max(LOOP_GAIN, self._gain / (1 + self._gain))
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


# A prompted board.

MEMORY = 64
"""Lines that are remembered because their replies may still come."""

FAST = 0.05
"""Gain per reply or read of the filters for the usual delay, its spread and the batches."""

SLOW = 0.0125
"""Gain per read of the slower filter that decides whether the spread is the board's."""

LEAST = 0.002
"""Gain per reply with which the least delay is forgotten: a time constant of 500 replies."""

CREEP = 0.05
"""Rise of the soonest delay per reply, in distances of two lines, by which it is forgotten."""

LATE = 1.25
"""Distances of two lines by which the soonest delay of the last replies may lie above the least
one. Above it, replies were lost. One distance is too little: a delay may rise by almost as much for
good."""

RARE = 0.002
"""Share of lost replies. Below it, a line that another one follows closely does not count as
lost."""

JITTER_NS = 350_000
"""Mean deviation that USB and the scheduler add to a constant delay, ns."""

THOUGHT_NS = 800_000
"""Mean deviation that USB and the scheduler rarely cause, ns. Above it, the board's delay
varies."""

RISE_NS = 20_000
"""Rise of a batched link's least delay per read, by which the link forgets it, ns."""

LOSING = 0.005
"""Gain per read of the share of lost replies. It is slow, because over 20 reads two lost replies
would already make it 3 %."""

LOSSY = 0.03
"""Share of lost replies on a batched link. Above it, any line may lack its reply."""

SEVERAL = 0.15
"""Share of the reads that hold several lines. Above it, an adapter batches lines; host stalls alone
cause fewer."""

THINKS = 0.6
"""Filtered share of the reads with a varying delay. Above it, the variation is the board's own. An
adapter that is filled line by line causes it too, but only for a quarter of a second."""

BATCH_NS = 2_000_000
"""Mean deviation that no board causes, ns: an adapter holds the lines back."""


class PromptedTimes:
    """The sample times of a prompted board, from the command lines that its replies answer.

    A plain reply does not name its line. But a board that answers each line samples at that moment,
    so the times at which the lines left are the sample times. Two replies are as far apart as their
    lines, whenever the host reads them, and where no line left no reply is missing.

    Replies come in the order of the lines. If a reply is later than usual by more than half the
    distance from its line to the next one, it answers that next line and the reply before it was
    lost.
    """

    def __init__(self, soonest_ns: int) -> None:
        """Start; `soonest_ns` is the wire time of a line and its reply."""
        self._soonest = soonest_ns
        self._left: deque[int] = deque(maxlen=MEMORY)
        self.forget()

    def forget(self) -> None:
        """Forget all lines: they are answered or will never be."""
        self._left.clear()
        self.restart()

    def restart(self) -> None:
        """Forget which line was answered last: the next reply answers the newest one that it can.

        The lines stay, because replies to the last ones are still on the way.
        """
        self._delay: float | None = None
        self._spread = self._least = 0.0
        """Mean deviation of the usual delay, and the least delay; both ns."""
        self._soon = 0.0
        """Least delay of the last replies, ns."""
        self._sent: int | None = None
        self._apart = self._missing = 0.0
        """Time at which the last line left, usual distance of two lines, share of lost replies."""
        self._last: int | None = None
        """Time of the line that was answered last, plus the excess of its reply over the usual
        delay, ns."""
        self._passed = self._line = 0
        """Times of the last line that is answered or given up, and of the last that is answered."""
        self._lost = False
        """Whether the last lone reply made the code give up the line before its own."""
        self._at, self._alone = 0, False
        self._base, self._batch, self._losses = 0.0, 2e7, 0.0
        """For a batched link: least delay and usual distance of two reads, both ns, and share of
        lost replies."""
        self._several = 0.0
        """Share of the reads that hold several lines."""
        self._thinking = 0.0
        """Filtered share of the reads in which the delay varied more than a scheduler or an adapter
        causes."""

    @property
    def thinks(self) -> bool:
        """Whether the reply delay varies more than this computer or its USB adapter can cause."""
        return self._thinking > THINKS and not self._batched

    @property
    def lossy(self) -> bool:
        """Whether replies get lost on a batched link. There no clock of slots can be found."""
        return self._batched and self._losses > LOSSY

    @property
    def _batched(self) -> bool:
        """Whether an adapter holds replies back, so that one read brings several."""
        return self._several > SEVERAL

    def left(self, at_ns: int) -> None:
        """Note that a line left at `at_ns`."""
        if self._sent is not None:
            apart, usual = at_ns - self._sent, self._apart
            self._apart = usual + FAST * (min(apart, 2 * usual) - usual) if usual else apart
        self._sent = at_ns
        self._left.append(at_ns)

    def read(self, at_ns: int, lines: int) -> None:
        """Take a read of `lines` lines, of which the last was complete at `at_ns`.

        The delay of a lone reply shows which line it answers. So does the delay of a batch if it is
        longer than the adapter ever holds a reply back.
        """
        alone, since = lines == 1, at_ns - self._at
        self._at, self._alone = at_ns, alone
        self._several += FAST * ((not alone) - self._several)
        varies = THOUGHT_NS < self._spread < BATCH_NS and not self._batched
        self._thinking += SLOW * (varies - self._thinking)
        if self._batched:
            self._soon = 0.0
            self._weigh(lines, since)
        elif self._delay is not None:
            self._base, self._losses = self._delay, 0.0

    def place(self, asked_ns: int | None = None) -> Placed | None:
        """Return the time of the next reply, or None if no line waits for a reply.

        `asked_ns` is when the line left, if the reply names its line.
        """
        left = self._left
        if asked_ns is not None:
            while left and left[0] < asked_ns:
                self._passed = left.popleft()
            if left and left[0] == asked_ns:
                left.popleft()
            if self._delay is None:
                self._delay = self._least = float(max(self._at - asked_ns, self._soonest))
            return self._answered(asked_ns)
        if self._delay is None:
            self._begin()
        elif self._alone and not self._batched and self._given_up_too_early(self._delay):
            return self._answered(self._passed)
        if not left:
            self._last = None
            return None
        return self._answered(left.popleft())

    def _answered(self, line: int) -> Placed:
        last, before = self._last, self._passed
        lost, self._passed, self._line = before > self._line, line, line
        at = line + (self._shift(line) if self._alone else 0)
        self._last = at if last is None else max(last, at)
        due_ns = at + int(self._delay or self._soonest)
        if last is None:
            return Placed("prompts", due_ns)
        dt = self._last - last
        bridged = min(max(0, before - last), dt) if lost else 0
        return Placed("prompts", due_ns, dt / NS_PER_S, bridged / NS_PER_S)

    def skip(self) -> None:
        """Note that the next reply was damaged."""
        if self._left:
            self._passed = self._left.popleft()

    def _begin(self) -> None:
        """Assign the first reply to the newest line that it can answer.

        Only the wire time of a reply is known yet.
        """
        left = self._left
        while len(left) > 1 and left[1] + self._soonest <= self._at:
            self._passed = left.popleft()
        if left:
            self._delay = self._least = float(self._at - left[0])

    def _weigh(self, lines: int, since: int) -> None:
        """Give up lines for which the last reply of a batch is too late.

        `since` is the time since the read before, ns.
        If many replies are lost, the first reply of the batch decides instead, because it was made
        after the batch before.
        """
        left, at = self._left, self._at
        judged, soonest = lines - 1, float(self._soonest)
        if self.lossy:
            judged, soonest = 0, max(soonest, self._base - JITTER_NS)
        if since < 1.5 * self._batch:
            self._batch += FAST * (since - self._batch)
        if len(left) < lines or self._delay is None:
            return
        if at - left[lines - 1] < self._soonest:  # too soon for a reply: it answers the line before
            left.appendleft(self._passed)
            self._base = float(at - left[lines - 1])
        lost = 0
        while len(left) > lines:
            late = at - left[judged] - self._base
            if late <= self._batch + 2 * JITTER_NS or at - left[lines] < soonest:
                break
            self._passed, lost = left.popleft(), lost + 1
        self._losses += LOSING * (lost / (lines + lost) - self._losses)
        # Giving up a line too late makes a reply look late, but nothing makes one look early. The
        # base is therefore the least delay, and it rises slowly.
        self._base = min(self._base + RISE_NS, at - left[lines - 1])
        self._delay = self._base

    def _given_up_too_early(self, delay: float) -> bool:
        """Return whether the line given up last was not lost.

        If it was, give up the lines lost now.
        """
        left, at, wide = self._left, self._at, 4 * self._spread
        lost, self._lost = self._lost, False
        self._missing -= LOSING * self._missing
        # No reply comes sooner than the least delay. One that seems to is a late reply to the line
        # before.
        soonest = max(float(self._soonest), self._least)
        if left:
            self._soon = min(self._soon + CREEP * self._apart, at - left[0])
            if self._soon - soonest > LATE * self._apart:
                # All of the last replies are late by more than a line, so replies were lost that
                # the spread had hidden.
                delay = self._delay = self._soon = soonest
                wide = self._spread = 0.0
        while len(left) > 1:
            apart = left[1] - left[0]
            if at - left[0] - delay <= max(apart / 2, wide) or at - left[1] < soonest:
                break
            # After a host stall two lines leave at once and the reply to the first one is late, but
            # not so late that the reply to the second one should have been read too.
            overdue = at - left[1] - delay > max(self._apart / 2, wide)
            close = apart < self._apart / 2 and not overdue
            if close and self._missing < RARE:
                break
            self._passed, self._lost = left.popleft(), True
            self._missing += LOSING * (not close)
        if not lost or not left:
            return lost
        return at - left[0] - delay <= -max((left[0] - self._passed) / 2, wide)

    def _shift(self, line: int) -> int:
        """Return the excess of a lone reply's delay over the usual, ns, and update the usual.

        Return 0 if the delay varies no more than the time of a read does by itself, or if an
        adapter causes the variation.
        """
        delay, spread = self._delay, self._spread
        if delay is None or self._batched:
            return 0
        error = self._at - line - delay
        if abs(error) >= max(delay, 4 * spread):
            return 0  # a host stall
        self._delay = delay + FAST * error
        self._least = min(self._least + LEAST * (delay - self._least), delay + error)
        self._spread += FAST * (abs(error) - spread)
        if not JITTER_NS < spread < BATCH_NS or abs(error) > 4 * spread:
            return 0
        return int(error * (1 - (JITTER_NS / spread) ** 2))
