"""Estimates when the board read its encoders, with one clock for each of two kinds of boards.

The time at which the host reads a line is not the time of its sample: an adapter, the scheduler or
a stall of the host may have held the line back. `FreeRunningTimes` finds the period of a board that
reports by its own clock. For a board that answers each command line, `PromptedTimes` uses the times
at which the command lines were written. For each read of the port, call `read` on both classes.
Then `place` returns the time of each line of the read as a `Placed`. `forget` starts a new session.
`feedback.py` chooses the better clock for each line.
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
"""The time at which the last line of a read was complete, ns, and the number of lines in the
read."""

BRIDGED_S = 1.0
"""Longest gap between two lines that is filled, s. After a longer one the board may have been
reset."""


class Placed(Struct, frozen=True, gc=False):
    """The time of a line according to one of the clocks.

    `clock` is "slots" for `FreeRunningTimes`, "prompts" for `PromptedTimes`, and "reads" for the
    times of the reads. `due_ns` is the monotonic time at which the host should have received the
    whole line, ns.
    """

    clock: Literal["slots", "prompts", "reads"]
    due_ns: int
    dt: float | None = None
    """Time since the previous line that this clock placed, s. None for the first such line, and for
    the clock "reads"."""
    bridged: float = 0.0
    """The part of `dt` whose lines were lost, s."""
    early: bool = False
    """Whether the line came before it was due. Then `due_ns` is the time of its arrival, and the
    time to the next line is the difference of the two `due_ns`."""


# A free-running board. A slot is one period of its clock, in which it sends one line.

WINDOW_NS, WINDOW_READS = NS_PER_S // 2, 12
"""Least duration of a window, ns, and its least number of reads. A clock is found or corrected from
the reads of one window."""

LOOP_GAIN = 0.2
"""Gain g of the loop in `FreeRunningTimes` after it has settled. One window determines the error x
of the clock to a few hundredths of a slot."""

DRIFT = 0.01
"""Largest relative error of a board's clock. A ceramic resonator has half of it."""

EXACT = 0.001
"""Relative error within which a measured period that is not configured is rounded to whole ms. It
covers the error of a quartz and the error of the fit."""

LONE = 0.7
"""If at least this share of the reads contains a single line, lines are treated as read one by
one."""

LATE_ALONE, LATE_BATCHED = 0.6, 1.3
"""Largest lateness of a line, in slots, in the window from which a clock is found. `LATE_ALONE` is
for lines that are read one by one, `LATE_BATCHED` for batches; `HELD_NS` limits both."""

HELD_NS = 25_000_000
"""Longest time for which an adapter is assumed to hold a line back, ns. An FTDI chip holds it for
16 ms. At 20 Hz and less, a later line answers a command that was sent between two periods. If the
lines of a slow board really vary by more, no clock is found, and the times of the reads are
used."""

EARLY_ALONE, ALONE = 0.55, 12
"""Limit for lines that came out of turn, in the window from which a clock is found. Such a line
answers a command that was sent between two periods, and is earlier than the others by more than
`EARLY_ALONE` slots. One such line is allowed, and one more for each `ALONE` reads. With more of
them the clock is refused, because it would make all other lines a slot late."""

JUMP = 1.4
"""If two reads with a single line each are less than this number of slots apart, no line is missing
between them."""

SURE = 0.15
"""Margin in slots. If the last line of a read is later than its greatest possible lateness by more
than one slot and this margin, a line is missing."""

EARLY = 0.25
"""If a line of a window is earlier than its slot by more than this number of slots, the clock is
wrong."""

LOSSY_READS = 0.45
"""If more than this share of the reads in two windows follows missing lines, the period is
wrong."""


class FreeRunningTimes:
    """The sample times of a free-running board, from the times at which its lines were read.

    The board makes one line in each slot of length T. The time of a read alone does not show to
    which slot a line belongs: an adapter holds lines back, and during a host stall they wait in the
    kernel. Let a be the time of a read, k the slot of its last line and c the time of slot 0. Then

        (1)  x = (a - c) / T - k

    is the lateness of the read's last line in slots. Each missing line adds 1 to x.

    If lines are read one by one, x is about 0, and a line that is read alone shows at once how many
    lines are missing before it. If an adapter batches lines, x lies between 0 and 1. Then a read
    shows single missing lines only if it came at least as soon after the previous read as usual.
    Any other read shows a missing line only if x exceeds the greatest possible lateness. The
    missing slots are spread over the lines of the read. A line that comes before its slot shows
    that too many slots were counted as missing, so one is taken back. Twice a second the least x
    corrects c and T in a second-order loop with the gain g:

        (2)  c += g x T                 (3)  T += g^2 / 2 x T / slots

    No clock is found for lines without a regular period. A clock that the lines contradict is given
    up.
    """

    def __init__(self, known: tuple[float, ...]) -> None:
        """Start. `known` contains the periods that the configuration suggests, s."""
        self._known = known
        self.usual = 0.0
        """The last measured T, ns. 0 until a clock has been found."""
        self._stretch = 1.0
        """Slots per line of the last read, including its share of the missing lines."""
        self._before = 0
        self._first, self._slot = 0.0, 0
        """The time c of slot 0, ns, and the slot k of the last line."""
        self._given = 0
        """Number of slots that were recently counted as missing lines. They may be taken back."""
        self._lag = self._batch = self._gain = self._share = 0.0
        """`_lag` is the usual x of a read, `_batch` the usual time between two reads in slots,
        `_gain` the gain g, and `_share` the share of the reads that follow missing lines."""
        self._batched: bool = False
        """Whether an adapter batches lines."""
        self._alone: bool = False
        """Whether the last read had a single line."""
        self._least: float
        self._begin(0)
        self.forget()

    def forget(self) -> None:
        """Give up the clock, because the board has changed or has another period."""
        self.period: float | None = None
        """Nominal period of the firmware, s. None while no clock is known. The firmware divides its
        counts by this period even if its clock is fast or slow."""
        self._reads: list[Read] = []
        self._last: float | None = None
        """Slot of the last line that the present clock has placed. None before the first one."""

    def read(self, at_ns: int, lines: int, drained: bool) -> int:
        """Process a read, and return the number of lines that were lost before its last line.

        The result is -1 if one slot too many had been counted as missing.

        Args:
            at_ns: The monotonic time at which the last line was complete.
            lines: The number of lines in the read.
            drained: Whether the read took all data that the kernel held.
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
            self.forget()  # the lines come too early or later and later: another clock
            return 0
        self._slot += lost
        # If the missing lines cover more time than may be filled, place them all before the read.
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
        """Mean time from the slot of a line to its read, ns."""
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
        """Return the number of missing lines that this read proves.

        Return -1 if the read contradicts the clock.

        Args:
            ahead: The lateness x of the read's last line, slots.
            since: The time since the last read, slots.
            lines: The number of lines in the read.
            drained: Whether the read took all data that the kernel held.
        """
        lag = min(self._lag, 0.5)
        if ahead < -0.5 + 0.6 * lag:
            return -1
        if not drained:
            return 0
        alone, self._alone = self._alone, lines == 1
        if self._batched:
            prompt = since < 1.1 * self._batch and lines - 1 < since
            held = self._batch + 1.0  # an adapter also holds back the last line of a backlog
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
            latest = min(most, HELD_NS / guess)
            if max(late) <= latest and sorted(late)[1 + len(late) // ALONE] <= EARLY_ALONE:
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

        A candidate consists of the slot of each read's last line, the largest allowed lateness in
        slots, and the period in ns. `gaps` are the times between the reads, ns. The order has three
        reasons:

        - For jittery lines a configured period is more reliable than half a second of data.
        - An adapter that holds lines back also passes them on one by one if they fill its packets.
          So the configured periods are tried without missing lines before any other period is tried
          with missing lines.
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
        """Start a window: reset its least x and the numbers of reads, slots and lossy reads."""
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
        # Keep the time of the present line unchanged.
        self._first -= (usual - self.usual) * self._slot
        self.usual = usual
        self.period = self._nominal()
        self._given = self._given if self._lossy else 0
        self._begin(at_ns)

    def _nominal(self) -> float:
        """Return the nominal period of the firmware, s.

        It is a configured period or a whole number of milliseconds if the measured period is close
        to one of them. Otherwise it is the measured period.
        """
        seconds = self.usual / NS_PER_S
        for known in self._known:
            if abs(seconds / known - 1) < DRIFT:
                return known
        whole = max(1, round(seconds * 1000)) / 1000
        return whole if abs(seconds / whole - 1) < EXACT else seconds


def _slots(reads: list[Read], period: float = math.inf) -> list[int]:
    """Return the slot of each read's last line, from 0 for the first read.

    With a finite `period`, ns, a longer gap between two reads is counted as missing lines.
    """
    slots = [0]
    for (before, _), (at, lines) in pairwise(reads):
        slots.append(slots[-1] + max(lines, round((at - before) / period)))
    return slots


def _slope(reads: list[Read], slots: list[int]) -> float:
    """Return the period in ns that fits the reads and their slots by least squares."""
    origin = reads[0][0]
    times = [at - origin for at, _ in reads]
    middle, centre = fmean(slots), fmean(times)
    spread = math.fsum((slot - middle) ** 2 for slot in slots)
    rows = zip(slots, times, strict=True)
    return math.fsum((slot - middle) * (time - centre) for slot, time in rows) / spread


def _latest(reads: list[Read], slots: list[int], period: float) -> tuple[float, list[float]]:
    """Return the latest time of slot 0 for which no line is early, ns.

    Also return the lateness of each read's last line, in slots. `period` is in ns.
    """
    offsets = [at - slot * period for (at, _), slot in zip(reads, slots, strict=True)]
    first = min(offsets)
    return first, [(offset - first) / period for offset in offsets]


# A prompted board.

MEMORY = 64
"""Largest number of written lines that are remembered because their replies may still come."""

FAST = 0.05
"""Gain per reply or read of the filters for the usual delay, its spread and the batches."""

SLOW = 0.0125
"""Gain per read of the slower filter that decides whether the board itself varies the delay."""

LEAST = 0.002
"""Gain per reply with which the least delay rises towards the usual delay: a time constant of 500
replies. So an outdated least delay is forgotten."""

CREEP, CREEPS_FOR = 0.05, 3
"""Rise of the least delay of the last replies, as a fraction of the time since the last reply. So
the delays of older replies are forgotten. The time is limited to between one and `CREEPS_FOR` times
the usual time between two lines, because a board may stall and then answer all lines."""

LATE = 1.25
"""Largest difference between the least delay of the last replies and the long-term least delay, in
usual times between two lines. Above it, replies were lost. A limit of 1 is too low, because the
delay may permanently rise by almost that much."""

RARE = 0.002
"""Share of lost replies below which the reply to a line is not taken for lost if another line
follows that line closely."""

JITTER_NS = 350_000
"""Mean deviation of the delay that USB and the scheduler add to a constant delay, ns."""

THOUGHT_NS = 800_000
"""Mean deviation of the delay above which the board itself varies it, ns. USB and the scheduler
rarely cause as much."""

RISE_NS = 20_000
"""Rise per read of the least delay on a batched link, ns. So an outdated least delay is forgotten.
A link is batched if an adapter holds replies back, so that one read contains several."""

LOSING = 0.005
"""Gain of the filter for the share of lost replies. It is small, because a filter over 20 reads
would already show 3 % after two lost replies."""

LOSSY = 0.03
"""Share of lost replies on a batched link above which any line may lack its reply."""

SEVERAL = 0.15
"""Share of the reads with several lines above which an adapter batches lines. Host stalls alone
cause fewer such reads."""

THINKS = 0.6
"""Filtered share of the reads with a varying delay above which the board itself varies the delay.
An adapter that is filled line by line causes a varying delay too, but only for a quarter of a
second."""

BATCH_NS = 2_000_000
"""Mean deviation of the delay above which an adapter holds the lines back, ns. No board causes as
much."""


class PromptedTimes:
    """The sample times of a prompted board, from the command lines that its replies answer.

    A plain reply does not say which line it answers. However, a board that answers each line takes
    its sample when the line arrives. So the times at which the lines were written are the sample
    times, except for a usual delay. The time between two samples is the time between their lines,
    even if the host reads the replies late. If no line was written, no reply is missing.

    Replies come in the order of the lines. Suppose that a reply is later than usual by more than
    half the time from its line to the next line. Then it answers the next line, and the reply to
    the earlier line was lost.
    """

    def __init__(self, soonest_ns: int) -> None:
        """Start. `soonest_ns` is the least possible delay of a reply, ns.

        It is the wire time of a line and its reply.
        """
        self._soonest = soonest_ns
        self._left: deque[int] = deque(maxlen=MEMORY)
        self.forget()

    def forget(self) -> None:
        """Forget all lines, because they are answered or will never be answered."""
        self._left.clear()
        self.restart()

    def restart(self) -> None:
        """Forget which line was answered last, and the usual delay.

        The next reply is then assigned to the newest line that it can answer. The lines are kept,
        because replies to the last ones may still come.
        """
        self._delay: float | None = None
        self._first = False
        """Whether the usual delay was measured on the first reply alone."""
        self._spread = self._least = 0.0
        """`_spread` is the mean deviation from the usual delay, and `_least` the long-term least
        delay, both ns."""
        self._soon = 0.0
        """Least delay of the last replies, ns."""
        self._sent: int | None = None
        self._apart = self._missing = 0.0
        """`_sent` is the time at which the last line was written, and `_apart` the usual time
        between two lines, both ns. `_missing` is the share of lost replies."""
        self._last: int | None = None
        """Time of the last answered line, plus the excess of its reply's delay over the usual
        delay, ns."""
        self._passed = self._line = 0
        """`_passed` is the time of the last line that was answered or given up, and `_line` that of
        the last line that was answered, both ns."""
        self._lost = False
        """Whether a line was given up because of the last reply that was read alone."""
        self._given: list[int] = []
        """Lines that the last read of a batched link gave up, in order. Their replies may have
        waited in an adapter that stalled."""
        self._at, self._alone, self._since = 0, False, 0
        self._base, self._batch, self._losses = 0.0, 2e7, 0.0
        """For a batched link: `_base` is the least delay and `_batch` the usual time between two
        reads, both ns. `_losses` is the share of lost replies."""
        self._several = 0.0
        """Filtered share of the reads that have several lines."""
        self._thinking = 0.0
        """Filtered share of the reads in which the delay varied more than a scheduler or an adapter
        causes."""

    @property
    def thinks(self) -> bool:
        """Whether the reply delay varies more than this computer or its USB adapter can cause."""
        return self._thinking > THINKS and not self._batched

    @property
    def lossy(self) -> bool:
        """Whether replies get lost on a batched link, where `FreeRunningTimes` finds no clock."""
        return self._batched and self._losses > LOSSY

    @property
    def _batched(self) -> bool:
        """Whether an adapter holds replies back, so that one read brings several."""
        return self._several > SEVERAL

    def left(self, at_ns: int) -> None:
        """Record that a command line was written at `at_ns` on the monotonic clock."""
        if self._sent is not None:
            apart, usual = at_ns - self._sent, self._apart
            self._apart = usual + FAST * (min(apart, 2 * usual) - usual) if usual else apart
        self._sent = at_ns
        self._left.append(at_ns)

    def read(self, at_ns: int, lines: int, cut: bool = False) -> None:
        """Process a read of `lines` lines. The last was complete at the monotonic time `at_ns`.

        `cut` says whether the read ends within a further line.

        The delay of a reply that is read alone shows which line it answers. The delay of a batch
        shows it only if it is longer than the adapter ever holds a reply back.
        """
        alone, since = lines == 1, at_ns - self._at
        self._at, self._alone, self._since = at_ns, alone, since
        self._several += FAST * ((not alone) - self._several)
        varies = THOUGHT_NS < self._spread < BATCH_NS and not self._batched
        self._thinking += SLOW * (varies - self._thinking)
        if self._batched:
            self._soon = 0.0
            self._weigh(lines, since, cut)
            return
        self._given = []
        if self._delay is not None:
            self._base, self._losses = self._delay, 0.0

    def place(self, asked_ns: int | None = None) -> Placed | None:
        """Return the time of the next reply, or None if no line waits for a reply.

        `asked_ns` is the monotonic time at which the answered line was written, if the reply names
        that line. Otherwise it is None.
        """
        left = self._left
        if asked_ns is not None:
            while left and left[0] < asked_ns:
                self._passed = left.popleft()
            if left and left[0] == asked_ns:
                left.popleft()
            if self._delay is None:
                self._start(max(self._at - asked_ns, self._soonest))
            return self._answered(asked_ns)
        second = self._first
        if self._delay is None:
            self._begin()
        elif self._alone and not self._batched and self._given_up_too_early(self._delay):
            return self._answered(self._passed)
        if not left:
            self._last = None
            return None
        line = left.popleft()
        placed = self._answered(line)
        if second:
            self._shorten(line)
        return placed

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
        """Remove the line that the next reply answers, because the reply was damaged."""
        if self._left:
            self._passed = self._left.popleft()

    def _begin(self) -> None:
        """Discard the lines that are older than the one which the first reply answers.

        The usual delay is not known yet. So the reply is assigned to the newest line that was sent
        early enough for the wire time of a line and its reply.
        """
        left = self._left
        while len(left) > 1 and left[1] + self._soonest <= self._at:
            self._passed = left.popleft()
        if left:
            self._start(self._at - left[0])
            self._first = True

    def _start(self, delay_ns: int) -> None:
        self._delay = self._least = self._soon = float(delay_ns)

    def _shorten(self, line: int) -> None:
        """Correct the usual delay if a stall had delayed the first reply, on which it was measured.

        In that case the next reply, which answers `line`, comes much earlier than usual. Without
        this correction, the usual delay would fall by only 5 % of the difference per reply, and the
        difference would count as variation. A delay that varies much hides lost replies.
        """
        own = self._at - line
        self._first = own < (self._delay or 0) - self._apart / 2
        if self._first and self._alone and not self._batched:
            self._start(own)
            self._spread = 0.0

    def _weigh(self, lines: int, since: int, cut: bool) -> None:
        """Give up the lines whose replies were lost.

        The last reply of a batch shows the loss: it is too late for the line that it would answer.
        If many replies are lost, the first reply of the batch decides instead, because the board
        made it after the previous batch.

        Args:
            lines: The number of replies in the batch.
            since: The time since the previous read, ns.
            cut: Whether the read has a part of one more reply.
        """
        left, at, began = self._left, self._at, lines + cut
        judged, soonest = lines - 1, float(self._soonest)
        if self.lossy:
            judged, soonest = 0, max(soonest, self._base - JITTER_NS)
        if since < 1.5 * self._batch:
            self._batch += FAST * (since - self._batch)
        given, self._given, again = self._given, [], False
        # The part of a reply comes sooner than the whole one.
        earliest = self._soonest // 2 if cut else self._soonest
        while given and (len(left) < began or at - left[began - 1] < earliest):
            left.appendleft(given.pop())  # too soon: these replies answer lines that were given up
            again = True
        if len(left) < lines or self._delay is None:
            return
        if at - left[lines - 1] < self._soonest:  # too soon: the reply answers the previous line
            left.appendleft(self._passed)
            self._base = float(at - left[lines - 1])
        lost = 0
        while len(left) > began and not again:
            late = at - left[judged] - self._base
            if late <= self._batch + 2 * JITTER_NS or at - left[lines] < soonest:
                break
            self._passed, lost = left.popleft(), lost + 1
            self._given.append(self._passed)
        self._losses += LOSING * (lost / (lines + lost) - self._losses)
        # If a line is given up too late, a reply looks late, but nothing makes a reply look early.
        # So the base is the least delay, which rises slowly.
        self._base = min(self._base + RISE_NS, at - left[lines - 1])
        self._delay = self._base

    def _given_up_too_early(self, delay: float) -> bool:
        """Give up lines whose replies were lost.

        Return True if the line that was given up last was given up too early: the present reply
        answers it. `delay` is the usual delay, ns.
        """
        left, at, wide = self._left, self._at, 4 * self._spread
        lost, self._lost = self._lost, False
        self._missing -= LOSING * self._missing
        # No reply comes sooner than the least delay. A reply that seems to come sooner is a late
        # reply to the previous line.
        soonest = max(float(self._soonest), self._least)
        if left:
            most = CREEPS_FOR * self._apart
            rise = CREEP * min(max(self._since, self._apart), most)
            self._soon = min(self._soon + rise, at - left[0])
            if self._soon - soonest > LATE * self._apart:
                # All of the last replies are late by more than the time between two lines. So
                # replies were lost, but the large spread had hidden this.
                delay = self._delay = self._soon = soonest
                wide = self._spread = 0.0
        while len(left) > 1:
            apart = left[1] - left[0]
            if at - left[0] - delay <= max(apart / 2, wide) or at - left[1] < soonest:
                break
            # After a host stall two lines are written at once and the reply to the first one is
            # late, but not so late that the reply to the second one should have been read too.
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
        """Return by how much the delay of a reply that was read alone exceeds the usual delay, ns.

        Also update the usual delay. Return 0 if the delay varies no more than USB and the scheduler
        cause, or if an adapter or a host stall causes the variation. `line` is the time at which
        the answered line was written, ns.
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
