"""Estimates when the board read its encoders (the sample time), for two kinds of boards.

An adapter, the scheduler or a stall may delay a line. `FreeRunningTimes` finds the period of a
board that reports by its own clock, and `PromptedTimes` takes the times of the commands that a
board answers. After every read of the port, call `process_read`, and then `place` for each line.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from itertools import pairwise
from statistics import fmean, median
from typing import Literal

from msgspec import Struct

from acsard.core.values import NS_PER_S, Ns

Read = tuple[int, int]  # when the last line of a read was complete, and its number of lines

# Only shorter gaps are filled: the board may have been reset in a longer one.
MAX_FILLED_GAP_S = 1.0


class Placed(Struct, frozen=True, gc=False):
    """The time of a line by `FreeRunningTimes` (slots), `PromptedTimes` (prompts) or the reads.

    `due_ns` is when the host should have received the complete line.
    """

    clock: Literal["slots", "prompts", "reads"]
    due_ns: Ns
    dt: float | None = None  # s since the previous line by this clock; None for a first one
    bridged: float = 0.0  # s of it in which lines were lost
    # It came before the clock expected it. `due_ns` is then its arrival, and the next `dt` of the
    # clock is wrong: the caller subtracts the two `due_ns`.
    early: bool = False


# A free-running board. A slot is one period of its clock, in which the board sends one line.

# Least of a series of reads from which `FreeRunningTimes` finds or corrects a clock.
WINDOW_NS, WINDOW_READS = NS_PER_S // 2, 12

# Final gain g, from 1. One window shows the clock's error only to a few hundredths of a period.
LOOP_GAIN = 0.2

MAX_CLOCK_ERROR = 0.01  # relative; a ceramic resonator reaches half of it

# A period is rounded to whole ms only if this changes it less: a quartz and the measurement err so.
MAX_ROUNDING = 0.001

# Share of reads with a single line, from which on clocks for such reads are tried, too.
SINGLE_READ_FRACTION = 0.7

# Periods by which a line may come after its slot, read one by one or batched by an adapter
# (`MAX_ADAPTER_DELAY_NS` at most).
LATE_ALONE, LATE_BATCHED = 0.6, 1.3

# An FTDI chip holds a line for 16 ms. A later line answers a command, or its board has no clock.
MAX_ADAPTER_DELAY_NS = 25_000_000

# Only reads at most this many periods after their slot confirm a clock, more than one in
# `READS_PER_CONFIRMATION` beside the earliest. Others answer commands between periods.
MAX_CONFIRMING_LATENESS, READS_PER_CONFIRMATION = 0.55, 12

COMPLETE_PERIODS = 1.4  # between two reads of one line: below it, no line is missing

# A line that is later than an adapter's limit by a period and this margin shows a loss.
LATENESS_MARGIN = 0.15

# A line this many periods before its slot shows a wrong clock.
MAX_EARLY_PERIODS = 0.25

# Mean share, over two windows, of reads that follow missing lines, above which the period is wrong.
LOSSY_READ_FRACTION = 0.45


class FreeRunningTimes:
    """The sample times of a free-running board, from the times at which its lines were read.

    The board makes one line in each period T of its clock, a slot. With the time a of a read, the
    number k of the slot of its last line and the time c of slot 0, the lateness of this line in
    slots is

        (1)  x = (a - c) / T - k

    Each missing line adds 1. If lines are read one by one, x is about 0 and shows at once how many
    are missing. If an adapter batches them, x is between 0 and 1: a read no later than usual shows
    even one missing line, any other only if x exceeds the greatest possible lateness. The missing
    slots are spread over the lines of the read, and one is taken back if a line comes before its
    slot. Twice a second, with the least lateness x and the number n of slots since then, and the
    gain g,

        (2)  c += g x T                 (3)  T += g^2 / 2 x T / n

    The class finds no clock without a regular period, and gives up one that the lines contradict.
    """

    def __init__(self, known: tuple[float, ...]) -> None:
        self._known = known  # values of T that the configuration suggests, s
        self.usual = 0.0  # last measured T, ns; 0 before a clock was found
        self._stretch = 1.0  # slots per line of the last read: more than 1 if lines are missing
        self._before = 0
        self._first, self._slot = 0.0, 0  # c in ns, and k of the last line
        self._given = 0  # slots counted as missing by recent reads, to be taken back if none was
        # In slots: usual lateness of a read, and time between two. Gain. Lossy share of reads.
        self._lag = self._batch = self._gain = self._share = 0.0
        self._batched: bool = False
        self._alone: bool = False
        self._least: float
        self._begin(0)
        self.forget()

    def forget(self) -> None:
        """Give up the clock: the lines contradict it or may come from another board."""
        self.period: float | None = None  # nominal s by which the firmware divides its counts
        self._reads: list[Read] = []
        self._last: float | None = None  # of the last line that this clock has placed

    def process_read(self, at_ns: Ns, lines: int, drained: bool) -> int:
        """Process a read; return the number of missing lines before its last line.

        The result is -1 if earlier reads counted one too many. `drained`: the kernel holds no more
        data.
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
            self.forget()  # the lines come too early, or later and later: the clock is wrong
            return 0
        self._slot += lost
        # Missing lines over more time than may be filled are all placed before the read.
        self._stretch = (
            1.0 + lost / lines if lost * self.usual < MAX_FILLED_GAP_S * NS_PER_S else 1.0
        )
        self._given += lost
        self._passed += lines + lost
        self._lossy += lost > 0
        if lost <= 0:
            ahead -= lost
            if ahead < self._least:
                self._least = ahead
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
        """Mean time from the beginning of the period in which a line is due to its read, ns."""
        return self._lag * self.usual

    def place(self, behind: int) -> Placed | None:
        """Return the time of a line of the last read, `behind` lines before its end, or None."""
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
        # -1: the clock is wrong, or one was counted too many. `ahead` is x; `since` is in slots.
        lag = self._lag if self._lag < 0.5 else 0.5
        if ahead < -0.5 + 0.6 * lag:
            return -1
        if not drained:
            return 0
        alone, self._alone = self._alone, lines == 1
        if self._batched:
            prompt = since < 1.1 * self._batch and lines - 1 < since
            delay = self._batch + 1.0  # 1.0: an adapter also holds back the last line of a backlog
        else:
            delay, prompt = 0.0, lines == 1
            if prompt and alone and since < COMPLETE_PERIODS:
                return -1 if ahead > 1 else 0  # the delay grew line by line, so no line is missing
        missing = ahead + 0.5 - 1.4 * lag if prompt else ahead - LATENESS_MARGIN - delay
        return math.floor(missing) if missing > 0.0 else 0

    # Finding the clock and following it.

    def _seek(self, at_ns: Ns, lines: int) -> None:
        reads = self._reads
        reads.append((at_ns, lines))
        if len(reads) <= WINDOW_READS or at_ns - reads[0][0] < WINDOW_NS:
            return
        gaps = [after - before for (before, _), (after, _) in pairwise(reads)]
        for slots, most, guess in self._clocks(reads, gaps):
            first, late = _latest(reads, slots, guess)
            latest = min(most, MAX_ADAPTER_DELAY_NS / guess)
            confirming = sorted(late)[1 + len(late) // READS_PER_CONFIRMATION]
            if max(late) <= latest and confirming <= MAX_CONFIRMING_LATENESS:
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
        # The slot of each read's last line, the allowed lateness in slots, and the period in ns.
        # The configured periods come first: jittery lines make half a second of data less reliable.
        plain, known = _slots(reads), [period * NS_PER_S for period in self._known]
        alone = [gap for gap, (_, lines) in zip(gaps, reads[1:], strict=True) if lines == 1]
        own = plain
        # Bytes faster than the wire have equal times, so the median may be 0.
        if len(alone) >= SINGLE_READ_FRACTION * len(gaps) and (usual := median(alone)) > 0:
            own = _slots(reads, usual)
            yield from ((own, LATE_ALONE, period) for period in known)
        # Lines read one by one may also fill the packets of an adapter one by one.
        yield from ((plain, LATE_BATCHED, period) for period in known)
        slope = _slope(reads, own)
        if slope <= 0:
            return
        if own is not plain:
            yield own, LATE_ALONE, slope
        # Half a second of batched lines cannot distinguish it from a configured one this close.
        elif all(abs(slope / period - 1) > MAX_CLOCK_ERROR for period in known):
            yield own, LATE_BATCHED, slope

    def _begin(self, at_ns: Ns) -> None:
        self._window_ns: Ns = at_ns
        self._least = math.inf
        self._count: int = 0
        self._passed: int = 0
        # Number of reads that follow missing lines.
        self._lossy: int = 0

    def _follow(self, at_ns: Ns) -> None:
        # Equations (2) and (3) of the class.
        least, slots = self._least, self._passed
        lossy, self._share = self._share, self._lossy / self._count
        if (
            (lossy + self._share) / 2 > LOSSY_READ_FRACTION
            or least < -MAX_EARLY_PERIODS
            or least == math.inf
        ):
            self.forget()
            return
        self._gain = max(LOOP_GAIN, self._gain / (1 + self._gain))
        self._first += self._gain * least * self.usual
        usual = self.usual * (1 + self._gain**2 / 2 * least / slots)
        self._first -= (usual - self.usual) * self._slot
        self.usual = usual
        self.period = self._nominal()
        self._given = self._given if self._lossy else 0
        self._begin(at_ns)

    def _nominal(self) -> float:
        seconds = self.usual / NS_PER_S
        for known in self._known:
            if abs(seconds / known - 1) < MAX_CLOCK_ERROR:
                return known
        whole = max(1, round(seconds * 1000)) / 1000
        return whole if abs(seconds / whole - 1) < MAX_ROUNDING else seconds


def _slots(reads: list[Read], period: float = math.inf) -> list[int]:
    # From 0. With a finite `period`, ns, missing lines have slots.
    slots = [0]
    for (before, _), (at, lines) in pairwise(reads):
        slots.append(slots[-1] + max(lines, round((at - before) / period)))
    return slots


def _slope(reads: list[Read], slots: list[int]) -> float:
    origin = reads[0][0]
    times = [at - origin for at, _ in reads]
    middle, centre = fmean(slots), fmean(times)
    spread = math.fsum((slot - middle) ** 2 for slot in slots)
    rows = zip(slots, times, strict=True)
    return math.fsum((slot - middle) * (time - centre) for slot, time in rows) / spread


def _latest(reads: list[Read], slots: list[int], period: float) -> tuple[float, list[float]]:
    # The latest time of slot 0, ns, with no read before its slot; and each lateness in slots.
    offsets = [at - slot * period for (at, _), slot in zip(reads, slots, strict=True)]
    first = min(offsets)
    return first, [(offset - first) / period for offset in offsets]


# A prompted board.

MAX_OPEN_COMMANDS = 64  # replies to them may still come

# Gain for the usual delay, its spread, the times between commands and batches, and their share.
FAST_GAIN = 0.05

# Rise of the long-term least delay per reply: an outdated one is forgotten after 500.
LEAST_DELAY_GAIN = 0.002

# Rate at which the least delay of the last replies rises with the time since the last read, which
# counts as 1 to this many command intervals: a board may stall and then answer all lines.
LEAST_DELAY_RISE, MAX_RISE_PERIODS = 0.05, 3

# Command intervals of the last replies' least delay over the long-term one: more means lost
# replies. 1 is too low: the delay may rise by almost an interval for good.
LOST_REPLY_PERIODS = 1.25

# Share of lost replies below which a late reply after a stall proves no loss: the first of two
# close commands is late anyway.
RARE_LOSS_FRACTION = 0.002

# +1 with each reply near the usual delay, -1 with each much later one. At the lower bound, the
# usual delay was measured on an early reply.
MAX_SUPPORT, MIN_SUPPORT = 200, -8

MAX_USB_JITTER_NS = 350_000  # mean deviation of the delay that USB and the scheduler explain

DELAY_RISE_NS = 20_000  # per read of a batched link, so that an outdated least delay is forgotten

LOSS_GAIN = 0.005  # with 1/20, two lost replies would be enough to reach `LOSSY_FRACTION`

LOSSY_FRACTION = 0.03  # of lost replies; above it, any reply on a batched link may be missing

BATCH_READ_FRACTION = 0.15  # of reads with several lines: host stalls alone cause fewer

MIN_ADAPTER_JITTER_NS = 2_000_000  # mean deviation, above which the adapter varies the delay


class PromptedTimes:
    """The sample times of a prompted board, from the commands that its replies answer.

    A board that answers takes its sample when the command arrives, so the time between two samples
    is that between the two commands, even if the host reads the replies late. Replies come in the
    order of the commands. One that seems later than usual by more than half of the time to the next
    command answers that one, and the reply to the earlier command was lost.
    """

    def __init__(self, soonest_ns: Ns) -> None:
        self._soonest = soonest_ns  # a command and its reply on the wire
        self._left: deque[int] = deque(maxlen=MAX_OPEN_COMMANDS)
        self.forget()

    def forget(self) -> None:
        """Forget all commands: no more replies to them will come."""
        self._left.clear()
        self._delay: float | None = None
        self._first = False  # the usual delay was measured on the first reply alone
        # Mean deviation from the usual delay, and long-term least delay, ns.
        self._spread = self._least = 0.0
        self._soon = 0.0  # least delay of the last replies, ns
        self._support = 0  # of the usual delay (`MAX_SUPPORT`)
        self._sent: int | None = None
        self._apart = self._missing = 0.0  # usual ns between two commands, share of lost replies
        # Last answered command, with the estimate by which the board itself was late or early.
        self._last: int | None = None
        # Last command that waits for no reply (answered, skipped or given up), and last answered.
        self._passed = self._line = 0
        self._lost = False  # the last read with one reply showed a loss
        self._given: list[int] = []  # at the last read of a batched link; may still be delivered
        self._at, self._alone, self._since = 0, False, 0
        # Batched link: least delay, usual time between reads (both ns), share of lost replies.
        self._base, self._batch, self._losses = 0.0, 2e7, 0.0
        self._several = 0.0  # share of reads with several lines
        self._batched = False  # an adapter holds replies back

    @property
    def lossy(self) -> bool:
        """Whether an adapter batches the replies, and `LOSSY_FRACTION` of them are lost."""
        return self._batched and self._losses > LOSSY_FRACTION

    @property
    def latest_ns(self) -> Ns:
        """When the reply to the last command usually comes; 0 before it, and if unknown."""
        if self._sent is None or self._delay is None:
            return 0
        return self._sent + int(self._delay)

    def written(self, at_ns: Ns) -> None:
        if self._sent is not None:
            apart, usual = at_ns - self._sent, self._apart
            self._apart = usual + FAST_GAIN * (min(apart, 2 * usual) - usual) if usual else apart
        self._sent = at_ns
        self._left.append(at_ns)

    def process_read(self, at_ns: Ns, lines: int, cut: bool = False) -> None:
        """Process a read of `lines` complete replies, and of a part of one more if `cut`."""
        alone, since = lines == 1, at_ns - self._at
        self._at, self._alone, self._since = at_ns, alone, since
        self._several += FAST_GAIN * ((not alone) - self._several)
        self._batched = self._several > BATCH_READ_FRACTION
        if self._batched:
            self._soon = 0.0
            self._weigh(lines, since, cut)
            return
        self._given = []
        if self._delay is not None:
            self._base, self._losses = self._delay, 0.0

    def place(self, asked_ns: Ns | None = None) -> Placed | None:
        """Return the time of the next reply, or None if no command waits for a reply.

        `asked_ns` is its command, if the reply says so.
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
        command = left.popleft()
        placed = self._answered(command)
        if second:
            self._shorten(command)
        return placed

    def _answered(self, command: int) -> Placed:
        last, before = self._last, self._passed
        lost, self._passed, self._line = before > self._line, command, command
        at = command + (self._shift(command) if self._alone else 0)
        self._last = at if last is None or at > last else last
        due_ns = at + int(self._delay or self._soonest)
        if last is None:
            return Placed("prompts", due_ns)
        dt = self._last - last
        bridged = min(max(0, before - last), dt) if lost else 0
        return Placed("prompts", due_ns, dt / NS_PER_S, bridged / NS_PER_S)

    def skip(self) -> None:
        """Forget the command that the next reply answers, because this reply is damaged."""
        if self._left:
            self._passed = self._left.popleft()

    def _begin(self) -> None:
        # To the newest command that it can answer.
        left = self._left
        while len(left) > 1 and left[1] + self._soonest <= self._at:
            self._passed = left.popleft()
        if left:
            self._start(self._at - left[0])
            self._first = True

    def _start(self, delay_ns: Ns) -> None:
        self._delay = self._least = self._soon = float(delay_ns)
        self._support = 0

    def _shorten(self, command: int) -> None:
        # After a stall, the delay of the second reply is much shorter than the usual one, which
        # would fall by only 5 % per reply, seem to vary much, and hide lost replies.
        own = self._at - command
        self._first = own < (self._delay or 0) - self._apart / 2
        if self._first and self._alone and not self._batched:
            self._start(own)
            self._spread = 0.0

    def _weigh(self, lines: int, since: int, cut: bool) -> None:
        # If an adapter holds replies back: commands stop waiting, or wait again after a stall.
        # `cut`: the first part of one more reply is in the read.
        # The last reply of a batch shows a loss: it comes too late for the command that it would
        # answer if no reply were lost. If it comes too soon for its command, commands that were
        # given up before are taken back.
        left, at, began = self._left, self._at, lines + cut
        judged, soonest = lines - 1, float(self._soonest)
        if self.lossy:
            # If many replies are lost, the first reply of the batch decides instead, because the
            # board made it after the previous batch.
            judged, soonest = 0, max(soonest, self._base - MAX_USB_JITTER_NS)
        if since < 1.5 * self._batch:
            self._batch += FAST_GAIN * (since - self._batch)
        old_commands, self._given, again = self._given, [], False
        # The first part of a reply can come sooner than a complete reply.
        earliest = self._soonest // 2 if cut else self._soonest
        while old_commands and (len(left) < began or at - left[began - 1] < earliest):
            # Too soon: the replies answer commands that were given up.
            left.appendleft(old_commands.pop())
            again = True
        if len(left) < lines or self._delay is None:
            return
        if at - left[lines - 1] < self._soonest:  # too soon: the reply answers the previous command
            left.appendleft(self._passed)
            self._base = float(at - left[lines - 1])
        lost = 0
        while len(left) > began and not again:
            late = at - left[judged] - self._base
            if late <= self._batch + 2 * MAX_USB_JITTER_NS or at - left[lines] < soonest:
                break
            self._passed, lost = left.popleft(), lost + 1
            self._given.append(self._passed)
        self._losses += LOSS_GAIN * (lost / (lines + lost) - self._losses)
        # If a command is given up too late, a reply looks late, but nothing makes a reply look
        # early. So the base is the least delay, which rises slowly.
        self._base = min(self._base + DELAY_RISE_NS, at - left[lines - 1])
        self._delay = self._base

    def _given_up_too_early(self, delay: float) -> bool:
        # Stop waiting for replies that seem lost. True: the last call did so too early, and this
        # reply is that one. For a read of a single reply.
        left, at, wide = self._left, self._at, 4 * self._spread
        lost, self._lost = self._lost, False
        self._missing -= LOSS_GAIN * self._missing
        # No reply comes sooner than the least delay. A reply that seems to come sooner is a late
        # reply to the previous command.
        soonest = max(float(self._soonest), self._least)
        if left:
            most = MAX_RISE_PERIODS * self._apart
            rise = LEAST_DELAY_RISE * min(max(self._since, self._apart), most)
            self._soon = min(self._soon + rise, at - left[0])
            if self._soon - soonest > LOST_REPLY_PERIODS * self._apart:
                # All of the last replies are late by more than the time between two commands. So
                # replies were lost, but the large spread of the delay had hidden the loss.
                delay = self._delay = self._soon = soonest
                wide = self._spread = 0.0
                self._support = 0
        while len(left) > 1:
            apart = left[1] - left[0]
            if at - left[0] - delay <= max(apart / 2, wide) or at - left[1] < soonest:
                break
            # After a host stall, two commands are written in quick succession. The reply to the
            # first one is late, but not so late that the reply to the second one should have come.
            overdue = at - left[1] - delay > max(self._apart / 2, wide)
            close = apart < self._apart / 2 and not overdue
            if close and self._missing < RARE_LOSS_FRACTION:
                break
            self._passed, self._lost = left.popleft(), True
            self._missing += LOSS_GAIN * (not close)
        if not lost or not left:
            return lost
        return at - left[0] - delay <= -max((left[0] - self._passed) / 2, wide)

    def _shift(self, command: int) -> int:
        # Part of the difference from the usual delay, as USB and the scheduler change it, too. 0 if
        # these explain the mean deviation, if only an adapter does, or after a probable stall. For
        # a read of a single reply.
        delay, spread = self._delay, self._spread
        if delay is None or self._batched:
            return 0
        error = self._at - command - delay
        size = abs(error)
        if size < delay or size < 4 * spread:
            self._support = min(self._support + 1, MAX_SUPPORT)
        elif self._support > MIN_SUPPORT:
            self._support -= 1
            return 0  # a stall has probably delayed this reply
        self._delay = delay + FAST_GAIN * error
        self._least = min(self._least + LEAST_DELAY_GAIN * (delay - self._least), delay + error)
        self._spread += FAST_GAIN * (size - spread)
        if not MAX_USB_JITTER_NS < spread < MIN_ADAPTER_JITTER_NS or size > 4 * spread:
            return 0
        return int(error * (1 - (MAX_USB_JITTER_NS / spread) ** 2))
