"""Estimates when the board read its encoders (the sample time), for two kinds of boards.

The host reads a line later than its sample time, because an adapter, the scheduler or a stall of
the host may delay the line. `FreeRunningTimes` finds the period of a board that reports by its own
clock. For a board that answers each command, `PromptedTimes` uses the times at which the commands
were written. Each class serves as a clock: after every read of the port, call `process_read` on
both objects, and then `place` to get the time of each line of the read. `feedback.py` chooses the
better clock for each line.
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
"""A read of the port, as a pair: the monotonic time at which the last line of the read was
complete, ns, and the number of lines in the read."""

MAX_FILLED_GAP_S = 1.0
"""Shortest gap without a line that the odometry does not fill, s, because the board may have been
reset meanwhile. The odometry fills only shorter gaps."""


class Placed(Struct, frozen=True, gc=False):
    """The time of a line according to one of three clocks.

    `clock` is "slots" for `FreeRunningTimes`, "prompts" for `PromptedTimes`, and "reads" for the
    times at which the host read the port. `due_ns` is the monotonic time at which the host should
    have received the complete line, ns.
    """

    clock: Literal["slots", "prompts", "reads"]
    due_ns: int
    dt: float | None = None
    """Time since the previous line by this clock, s. None for the first line of the clock, and if
    the times of the host's reads serve as the clock."""
    bridged: float = 0.0
    """The part of the time since the previous line in which lines were lost, s."""
    early: bool = False
    """Whether the line came before the clock expected it. If so, `due_ns` is the time at which the
    line arrived, and the clock gives a wrong `dt` for the next line. The caller therefore computes
    the `dt` of the next line as the difference between the `due_ns` of the two lines."""


# A free-running board. A slot is one period of its clock, in which the board sends one line.

WINDOW_NS, WINDOW_READS = NS_PER_S // 2, 12
"""Least duration of a window, ns, and least number of reads in a window. A window is a series of
reads of the port from which `FreeRunningTimes` finds or corrects the clock of the board."""

LOOP_GAIN = 0.2
"""Final value of the gain g with which `FreeRunningTimes` corrects its clock. The gain starts at 1
and falls during the first windows. One window shows the error of the clock only to a few hundredths
of a period, so a small gain averages over several windows."""

MAX_CLOCK_ERROR = 0.01
"""Largest relative error of a board's clock. A ceramic resonator reaches half of it."""

MAX_ROUNDING = 0.001
"""Largest relative change of a measured period by rounding it to a whole number of ms. If the
change would be larger, the period is not rounded. The limit covers the error of a quartz and of the
measurement."""

SINGLE_READ_FRACTION = 0.7
"""If at least this share of the reads of the port has a single line, `FreeRunningTimes` also tries
clocks for lines that are read one by one. Otherwise it tries only clocks for lines that an adapter
batches."""

LATE_ALONE, LATE_BATCHED = 0.6, 1.3
"""Largest time by which a line may come after its slot, in periods of the board. A slot is the
period in which a line is due. If a line comes later, `FreeRunningTimes` does not accept the clock.
`LATE_ALONE` is for lines that are read one by one, and `LATE_BATCHED` for lines that an adapter
batches. `MAX_ADAPTER_DELAY_NS` limits both."""

MAX_ADAPTER_DELAY_NS = 25_000_000
"""Longest time for which an adapter is assumed to hold a line back, ns. An FTDI chip holds a line
for 16 ms. If a line comes later than this, `FreeRunningTimes` finds no clock. Such a line probably
answers a command that was sent between two periods, or its board is slow and its delay varies by
more than this time."""

MAX_CONFIRMING_LATENESS, READS_PER_CONFIRMATION = 0.55, 12
"""Limits for the reads that confirm a clock of the board. A read confirms a clock if it comes at
most `MAX_CONFIRMING_LATENESS` periods after its slot. The earliest read always confirms the clock.
`FreeRunningTimes` accepts the clock only if, in addition to the earliest read, more than one in
`READS_PER_CONFIRMATION` reads confirm it. If fewer reads do, these reads probably contain answers
to commands that were sent between two periods, and the clock is too early for all other lines."""

COMPLETE_PERIODS = 1.4
"""If the time between two reads with a single line each is below this limit, no line is missing
between them. The unit is the period of the board."""

LATENESS_MARGIN = 0.15
"""Margin on the lateness of a line, in periods. An adapter delays a line only up to a limit. If the
lateness exceeds this limit by more than one period plus the margin, an earlier line is missing."""

MAX_EARLY_PERIODS = 0.25
"""Largest time by which a line may come before its slot, in periods of the board. If a line comes
even earlier, `FreeRunningTimes` gives up its clock as wrong."""

LOSSY_READ_FRACTION = 0.45
"""If a larger share of the reads of the port follows missing lines, the period of the clock is
wrong. The share is a mean over two successive windows."""


class FreeRunningTimes:
    """The sample times of a free-running board, from the times at which its lines were read.

    The board makes one line in each period T of its clock. Such a period is called a slot. The time
    of a read alone does not show to which slot a line belongs: an adapter holds lines back, and
    during a host stall they wait in the kernel. Let a be the time of a read, k the number of the
    slot of its last line, and c the time of slot 0. Then the lateness of this line in slots is

        (1)  x = (a - c) / T - k

    Each missing line adds 1 to x. There are two cases:

    - Lines are read one by one. Then x is about 0, and each line shows immediately how many lines
      are missing before it.
    - An adapter batches lines. Then x lies between 0 and 1. If no more than the usual time has
      passed since the previous read, a read shows even a single missing line. Any other read shows
      a missing line only if x exceeds the greatest possible lateness.

    The missing slots are spread over the lines of the read. If a line comes before its slot, the
    class has counted too many slots as missing, so it subtracts one slot.

    Twice a second, a second-order loop corrects c and T. Let x be the least lateness since the last
    correction, n the number of slots since then, and g the gain of the loop. The corrections are

        (2)  c += g x T                 (3)  T += g^2 / 2 x T / n

    The class finds no clock if the lines have no regular period. It gives up a clock that the lines
    contradict.
    """

    def __init__(self, known: tuple[float, ...]) -> None:
        """Start before the period T and the time c of the board's slots are known.

        `known` contains the values of T that the configuration suggests, s.
        """
        self._known = known
        self.usual = 0.0
        """The last measured period T of the board, ns. 0 until a clock has been found."""
        self._stretch = 1.0
        """Number of slots per line of the last read: 1, or more if lines are missing before the
        read."""
        self._before = 0
        self._first, self._slot = 0.0, 0
        """The time c of slot 0, ns, and the number k of the slot of the last line."""
        self._given = 0
        """Number of slots that recent reads counted as slots of missing lines. If later lines show
        that no line was missing, these slots are taken back."""
        self._lag = self._batch = self._gain = self._share = 0.0
        """`_lag` is the usual lateness of a read after its slot, and `_batch` the usual time
        between two reads, both in slots. `_gain` is the gain of the loop that corrects the clock.
        `_share` is the share of the reads in the last window that follow missing lines."""
        self._batched: bool = False
        self._alone: bool = False
        self._least: float
        self._begin(0)
        self.forget()

    def forget(self) -> None:
        """Give up the clock, because the lines contradict it or may come from another board."""
        self.period: float | None = None
        """Nominal period by which the firmware divides its counts, s. None while no clock of the
        board is known."""
        self._reads: list[Read] = []
        self._last: float | None = None
        """Slot of the last line that the present clock has placed. None before the first line."""

    def process_read(self, at_ns: int, lines: int, drained: bool) -> int:
        """Process a read of the port, and return the number of missing lines before its last line.

        The result is -1 if the count of missing lines in earlier reads was too high by one. `at_ns`
        is the monotonic time at which the last line of the read was complete. `lines` is the number
        of lines in the read. `drained` is true if the read took all data from the kernel.
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
        # If the missing lines cover more time than may be filled, place them all before the read.
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
        """Mean time from the beginning of the period in which a line is due to the read of the
        line, ns."""
        return self._lag * self.usual

    def place(self, behind: int) -> Placed | None:
        """Return the time of a line of the last read, or None if no clock of the board is known.

        `behind` is the number of lines that follow the line in the read.
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
        """Return the number of missing lines that the last read proves.

        Return -1 if the clock is wrong, or an earlier read counted one slot too many as missing.
        `ahead` is the lateness x of the last line, and `since` the time since the previous read,
        both in slots. `lines` is the number of lines in the last read. `drained` is true if the
        read took all data from the kernel.
        """
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

    def _seek(self, at_ns: int, lines: int) -> None:
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
        """Yield possible clocks of the board, the likelier ones first.

        Each clock is a triple: a list of slots, the largest allowed lateness in slots, and the
        period in ns. The list of slots contains, for each read, the slot of its last line. `gaps`
        are the times between successive reads in `reads`, ns.
        """
        # The configured periods come before the measured period, because for jittery lines they are
        # more reliable than half a second of data.
        plain, known = _slots(reads), [period * NS_PER_S for period in self._known]
        alone = [gap for gap, (_, lines) in zip(gaps, reads[1:], strict=True) if lines == 1]
        own = plain
        # Bytes that come faster than the wire can carry them have equal times, so the median may be
        # 0.
        if len(alone) >= SINGLE_READ_FRACTION * len(gaps) and (usual := median(alone)) > 0:
            own = _slots(reads, usual)
            yield from ((own, LATE_ALONE, period) for period in known)
        # Lines that are read one by one may also fill the packets of an adapter one by one, so the
        # rules for an adapter that batches lines are tried in any case.
        yield from ((plain, LATE_BATCHED, period) for period in known)
        slope = _slope(reads, own)
        if slope <= 0:
            return
        if own is not plain:
            yield own, LATE_ALONE, slope
        # Half a second of batched lines cannot distinguish the measured period from a configured
        # period that is within `MAX_CLOCK_ERROR` of it.
        elif all(abs(slope / period - 1) > MAX_CLOCK_ERROR for period in known):
            yield own, LATE_BATCHED, slope

    def _begin(self, at_ns: int) -> None:
        self._window_ns: int = at_ns
        self._least = math.inf
        self._count: int = 0
        self._passed: int = 0
        # Number of reads that follow missing lines.
        self._lossy: int = 0

    def _follow(self, at_ns: int) -> None:
        """Correct the clock by equations (2) and (3) of the class, or give up a wrong clock."""
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
        # Keep the time of the present line unchanged.
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
    """Return the slot (the number of the board's period) of the last line of each read.

    The last line of the first read has the slot 0. By default, only received lines have slots. If
    `period`, ns, is finite, missing lines have slots too: a time of several periods between two
    reads shows that lines are missing.
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
    """Return the time of slot 0, ns, and the lateness of each read, in slots.

    The time of slot 0 is the latest one for which no read comes before its slot. So the least late
    read has the lateness 0.
    """
    offsets = [at - slot * period for (at, _), slot in zip(reads, slots, strict=True)]
    first = min(offsets)
    return first, [(offset - first) / period for offset in offsets]


# A prompted board.

MAX_OPEN_COMMANDS = 64
"""Largest number of commands that `PromptedTimes` remembers because replies may still come."""

FAST_GAIN = 0.05
"""Gain of several filters: for the usual reply delay and its spread, for the usual time between
commands, for the usual time between batches, and for the share of batches among the reads."""

SLOW_GAIN = 0.0125
"""Gain per read of the filter that decides whether the board itself varies the reply delay."""

LEAST_DELAY_GAIN = 0.002
"""Gain per reply with which the long-term least reply delay rises toward the usual reply delay.
With this gain, an outdated least delay is forgotten after about 500 replies."""

LEAST_DELAY_RISE, MAX_RISE_PERIODS = 0.05, 3
"""`LEAST_DELAY_RISE` is the rate at which the least delay of the last replies rises, so that
`PromptedTimes` forgets older replies. With each read of the port, the least delay rises by
`LEAST_DELAY_RISE` times the time since the previous read. For this purpose, the time since the
previous read counts as at least 1 and at most `MAX_RISE_PERIODS` times the usual time between two
commands. The upper limit is for a board that stalls and then answers all lines."""

LOST_REPLY_PERIODS = 1.25
"""Largest excess of the least delay of the last replies over the long-term least delay. The unit is
the usual time between two commands. A larger excess means that replies were lost. A limit of 1 is
too low, because the delay may permanently rise by almost the time between two commands."""

RARE_LOSS_FRACTION = 0.002
"""Share of lost replies below which a late reply after a host stall does not prove that a reply was
lost. After a host stall, two commands are written close together, so the reply to the first command
is late even if no reply was lost."""

MAX_SUPPORT, MIN_SUPPORT = 200, -8
"""Bounds of the support for the usual reply delay. Each reply with about this delay adds 1. Each
reply that comes much later, as after a stall, subtracts 1. At `MIN_SUPPORT`, stalls no longer
explain the late replies: the usual delay was measured on a reply that came unusually early."""

MAX_USB_JITTER_NS = 350_000
"""Largest mean deviation of the reply delay that USB and the scheduler explain, ns."""

MIN_BOARD_JITTER_NS = 800_000
"""Mean deviation of the reply delay above which the board itself varies the delay, ns. USB and the
scheduler rarely cause a deviation above this limit."""

DELAY_RISE_NS = 20_000
"""Rise of the least reply delay with each read on a batched link, ns. The rise makes
`PromptedTimes` forget an outdated value. A link is batched if an adapter holds replies back, so
that a read contains several replies."""

LOSS_GAIN = 0.005
"""Gain of the filter for the share of lost replies. With a gain of 1/20 instead, two lost replies
would be enough to reach `LOSSY_FRACTION`."""

LOSSY_FRACTION = 0.03
"""Share of lost replies above which a batched link counts as lossy. On a lossy link, the reply to
any command may be missing. A link is batched if an adapter holds replies back."""

BATCH_READ_FRACTION = 0.15
"""Share of the reads of the port with several lines above which an adapter must be batching lines.
Host stalls alone cause fewer such reads."""

BOARD_JITTER_FRACTION = 0.6
"""Share of the reads with a varied reply delay above which the board itself varies the delay. An
adapter whose packets fill line by line also varies the delay, but only for a quarter of a
second."""

MIN_ADAPTER_JITTER_NS = 2_000_000
"""Mean deviation of the reply delay above which an adapter and not the board varies the delay,
ns."""


class PromptedTimes:
    """The sample times of a prompted board, from the commands that its replies answer.

    A plain reply does not say which command it answers. However, a board that answers each command
    takes its sample when the command arrives. So the sample times are the times at which the
    commands were written, plus a usual delay. The time between two samples is the time between the
    two commands that the board answered, even if the host reads the replies late.

    Replies come in the order of the commands. A reply may seem later than usual by more than half
    of the time to the next command. Then it answers the next command, and the reply to the earlier
    command was lost.
    """

    def __init__(self, soonest_ns: int) -> None:
        """Start before the first command to the board.

        `soonest_ns` is the time that a command and its reply take on the wire together, ns.
        """
        self._soonest = soonest_ns
        self._left: deque[int] = deque(maxlen=MAX_OPEN_COMMANDS)
        self.forget()

    def forget(self) -> None:
        """Forget all commands, because no more replies to them will come."""
        self._left.clear()
        self.restart()

    def restart(self) -> None:
        """Forget which command was answered last, and the usual delay of the replies.

        The next reply is then assigned to the newest command that it can answer. The commands are
        not forgotten, because replies to the last commands may still come.
        """
        self._delay: float | None = None
        self._first = False
        """Whether the usual delay was measured on the first reply alone."""
        self._spread = self._least = 0.0
        """`_spread` is the mean deviation from the usual reply delay, ns. `_least` is the long-term
        least reply delay, ns."""
        self._soon = 0.0
        """Least delay of the last replies, ns."""
        self._support = 0
        """Support for the usual reply delay (see `MAX_SUPPORT`)."""
        self._sent: int | None = None
        self._apart = self._missing = 0.0
        """`_apart` is the usual time between two commands, ns. `_missing` is the share of lost
        replies."""
        self._last: int | None = None
        """Time at which the last answered command was written, ns. If the board itself answered
        later or sooner than usual, an estimate of this difference is added."""
        self._passed = self._line = 0
        """Both are times at which the daemon wrote a command, ns. `_line` belongs to the last
        answered command. `_passed` belongs to the last command that was answered, skipped or given
        up, so that it waits for no reply."""
        self._lost = False
        """Whether the last read with a single reply showed that an earlier reply was lost."""
        self._given: list[int] = []
        """The commands that were given up at the last read of a batched link, oldest first. Each is
        the time at which it was written, ns. An adapter that stalled may still deliver the replies
        to these commands."""
        self._at, self._alone, self._since = 0, False, 0
        self._base, self._batch, self._losses = 0.0, 2e7, 0.0
        """These values describe a batched link. `_base` is the least reply delay, ns. `_batch` is
        the usual time between two reads, ns. `_losses` is the share of lost replies."""
        self._several = 0.0
        """Filtered share of the reads that have several lines."""
        self._batched = False
        """Whether an adapter holds replies back, so that one read contains several."""
        self._thinking = 0.0
        """Filtered share of the reads in which the reply delay varied more than USB and the
        scheduler cause, but less than an adapter causes."""

    @property
    def varies_delay(self) -> bool:
        """Whether the board itself varies the delay of its replies.

        This is assumed if the delay varies by more than this computer and its USB adapter can
        cause.
        """
        return self._thinking > BOARD_JITTER_FRACTION and not self._batched

    @property
    def lossy(self) -> bool:
        """Whether an adapter batches the replies, and more than 3 % (`LOSSY_FRACTION`) are lost."""
        return self._batched and self._losses > LOSSY_FRACTION

    @property
    def latest_ns(self) -> int:
        """Monotonic time at which the reply to the last command usually comes, ns.

        It is 0 before the first command, and while the usual delay is unknown.
        """
        if self._sent is None or self._delay is None:
            return 0
        return self._sent + int(self._delay)

    def written(self, at_ns: int) -> None:
        """Record that a command was written at the monotonic time `at_ns`, ns."""
        if self._sent is not None:
            apart, usual = at_ns - self._sent, self._apart
            self._apart = usual + FAST_GAIN * (min(apart, 2 * usual) - usual) if usual else apart
        self._sent = at_ns
        self._left.append(at_ns)

    def process_read(self, at_ns: int, lines: int, cut: bool = False) -> None:
        """Process a read of the port that contains `lines` complete replies.

        The last complete reply was received at the monotonic time `at_ns`. `cut` is true if the
        read also contains the first part of one more reply.
        """
        alone, since = lines == 1, at_ns - self._at
        self._at, self._alone, self._since = at_ns, alone, since
        self._several += FAST_GAIN * ((not alone) - self._several)
        self._batched = self._several > BATCH_READ_FRACTION
        varies = MIN_BOARD_JITTER_NS < self._spread < MIN_ADAPTER_JITTER_NS and not self._batched
        self._thinking += SLOW_GAIN * (varies - self._thinking)
        if self._batched:
            self._soon = 0.0
            self._weigh(lines, since, cut)
            return
        self._given = []
        if self._delay is not None:
            self._base, self._losses = self._delay, 0.0

    def place(self, asked_ns: int | None = None) -> Placed | None:
        """Return the time of the next reply, or None if no command waits for a reply.

        `asked_ns` is the monotonic time at which the command that this reply answers was written,
        ns. It is None if the reply does not say which command it answers.
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
        """Assign the first reply to the newest command that this reply can answer."""
        left = self._left
        while len(left) > 1 and left[1] + self._soonest <= self._at:
            self._passed = left.popleft()
        if left:
            self._start(self._at - left[0])
            self._first = True

    def _start(self, delay_ns: int) -> None:
        self._delay = self._least = self._soon = float(delay_ns)
        self._support = 0

    def _shorten(self, command: int) -> None:
        """Correct the usual delay if it was measured on a reply that a stall had delayed."""
        # After a stall, the delay of the second reply is much shorter than the usual delay. Without
        # the correction, the usual delay would fall by only 5 % of the difference per reply. Until
        # then the delay would seem to vary much, which would hide lost replies.
        own = self._at - command
        self._first = own < (self._delay or 0) - self._apart / 2
        if self._first and self._alone and not self._batched:
            self._start(own)
            self._spread = 0.0

    def _weigh(self, lines: int, since: int, cut: bool) -> None:
        """Stop waiting for replies that were lost, if an adapter holds replies back.

        If a read shows that such a reply was only late, its command waits for the reply again.
        `lines` is the number of complete replies in the read. `since` is the time since the
        previous read, ns. `cut` is true if the read also contains the first part of one more reply.
        """
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
        """Stop waiting for replies that seem lost. Return whether the last call did so too early.

        The last call did so too early if a reply that seemed lost was only late. The present reply
        is then this late reply. Call this only if the last read of the port contained a single
        reply.
        """
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
        """Return an estimate of the extra time that the board took for the present reply, ns.

        USB and the scheduler also change the delay, so the result is only a part of the difference
        from the usual delay. The result is 0 in these cases:

        - The usual delay is unknown, or an adapter delivers several replies in one read.
        - USB and the scheduler explain the mean deviation from the usual delay.
        - The mean deviation is so large that an adapter must cause it.
        - A stall has probably delayed this reply.

        `command` is the time at which the answered command was written, ns. The present reply must
        be the only reply in its read of the port.
        """
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
