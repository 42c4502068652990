"""Estimates when the board read its encoders (the sample time), for two kinds of boards.

`mcu.reply_period` declares which one it is. A free-running board makes a line in each period of its
clock (`FreeRunning`). Any other makes one for each command (`Prompted`): its time is that of the
command, and the part of the reply's delay that is the board's own. Both count whole slots, a period
or a command, so that an error of one line is undone by the next.

The lateness of a line is its delay above the least one, in slots. A line that is later than usual
follows missing lines, and one that is too early shows that fewer are missing (`Lateness`).
"""

from __future__ import annotations

import math

from msgspec import Struct, field

from acsard.core.link.link_output import Output
from acsard.core.values import NS_PER_S, Ns

MAX_CLOCK_ERROR = 0.01  # relative; a ceramic resonator reaches half of it

# Mean deviation of the lateness, in slots, without the missing ones. Below it, one late line shows
# a loss. Above it, an adapter holds lines back, or the board answers at odd times, and only the
# earliest of some reads shows one, or a line that is later than an adapter can make it.
NARROW_DEVIATION = 0.17

LOSS_SLOTS, LOST_SLOTS = 0.6, 0.75  # more than usual; of the earliest of `LEAST_READS`

LEAST_READS = 8

# Lines that are counted one by one. After a longer silence, such as a night without power for the
# board, the rest is missing at once: counting 360,000 lines of an hour takes 0.2 s.
MAX_MISSING = 1000

MAX_ADAPTER_DELAY_NS = 25_000_000  # an FTDI chip holds a line for 16 ms

# A line that is earlier than this shows that a line was counted as missing, but came; and a reply,
# that a command was given up too soon.
EARLY_SLOTS, EARLY_REPLY = 0.5, 0.1

LAG_GAIN = 0.03

WINDOW_NS = NS_PER_S // 2  # of the least delay of a free-running board

# Missing lines among the last `LOSSY_LINES`. Above it, the link of a free-running board behind an
# adapter that holds lines back is lossy: nobody knows between which lines they are missing.
LOSSY, LOSSY_LINES = 2.0, 1000

LEAST_DELAY_GAIN = 0.002  # rise of the least delay per reply: an old one is forgotten after 500

# Mean deviation of the delay that USB and the scheduler explain, and above which an adapter is the
# cause. In between, it is the board's own.
USB_JITTER_NS, ADAPTER_JITTER_NS = 350_000.0, 2_500_000.0


class Lateness(Struct):
    """Tells whether lines are missing, from the lateness of the last line of each read, in slots.

    Each missing line adds 1 to all that follow.
    """

    usual: float = 0.0
    deviation: float = 0.0  # mean
    recent: list[float] = []  # of the last reads, if late

    def missing(self, late: float, lines: int, slot: Ns) -> bool:
        """Return whether a line is missing before the last line of a read of `lines`."""
        off, recent = late - self.usual, self.recent
        if off < LOSS_SLOTS:
            return False
        if self.deviation < NARROW_DEVIATION:
            # A stall of this computer, after which a read has several lines, adds less than 1.
            lost = lines == 1 or off > 1.0 + LOSS_SLOTS
        else:
            lost = late > 1.0 + MAX_ADAPTER_DELAY_NS / slot
        if not lost:
            least = min(recent, default=0.0) if len(recent) == LEAST_READS else 0.0
            lost = min(late, least) > LOST_SLOTS
        if lost:
            self.recent = [each - 1.0 for each in recent]
        return lost

    def follow(self, late: float) -> None:
        """Follow the lateness of a read before which no line is missing any more."""
        off = late - self.usual
        if late > LOST_SLOTS:
            self.recent.append(late)
            del self.recent[:-LEAST_READS]
            off -= round(off)
        elif self.recent:
            self.recent.clear()
        self.usual += LAG_GAIN * off
        self.deviation += LAG_GAIN * ((-off if off < 0.0 else off) - self.deviation)


# The time of a line: when it is expected here, the time since the previous one, and the part of
# that in which lines were lost.
Times = tuple[Ns, Ns, Ns]


class FreeRunning(Struct):
    """The lines of a board with its own clock, whose period is declared.

    A line takes one period, and one more for each line that is missing before it. On a lossy link,
    the lines of a read share the time since the line before them, by the times of arrival.
    """

    begun: bool = False
    late: float = 0.0  # of the last line, in periods
    lateness: Lateness = field(default_factory=Lateness)
    # Least lateness in a window, and its beginning: by as much our clock is ahead of the board's.
    least: float = math.inf
    window_ns: Ns = 0
    missing: float = 0.0  # among the last `LOSSY_LINES`
    lossy: bool = False
    expected_ns: Ns = 0  # time of the last line of the last read
    line_ns: Ns = 0  # that each line of the last read takes
    lost_ns: Ns = 0  # more for the next line; negative: lines before it have taken its time

    def process_read(self, end_ns: Ns, since_ns: Ns, lines: int, drained: bool, period: Ns) -> None:
        """Process a read; `drained`: the kernel has no more data."""
        if not self.begun:
            self.begun, self.line_ns = True, period
            self.window_ns = self.expected_ns = end_ns
            return
        passed = since_ns / period
        late, lost = self.late + passed - lines, 0
        if late < 0.0:  # the board's clock may be the faster one
            late = min(0.0, late + MAX_CLOCK_ERROR * passed)
        if late < -EARLY_SLOTS:
            lost = round(late)
        elif drained:
            if (lost := max(0, int(late) - MAX_MISSING)) > 0:
                self.lateness.recent = []
            while self.lateness.missing(late - lost, lines, period):
                lost += 1
            self.lateness.follow(late - lost)
        late -= lost
        self.least = min(self.least, late)
        if end_ns - self.window_ns > WINDOW_NS:
            most = MAX_CLOCK_ERROR * (end_ns - self.window_ns) / period
            if 0.0 < self.least < EARLY_SLOTS:  # else a line may be missing
                late -= min(self.least, most)
            self.window_ns, self.least = end_ns, math.inf
        self.late = late
        self.missing += lost - self.missing * min(1.0, lines / LOSSY_LINES)
        lossy, usual = self.lossy, self.lateness.usual
        self.lossy = self.missing > LOSSY and self.lateness.deviation >= NARROW_DEVIATION
        before_ns = self.expected_ns - self.lost_ns  # time of the last line that was used
        self.expected_ns = end_ns - int((usual if self.lossy else late) * period)
        if lossy or self.lossy:
            took_ns = self.expected_ns - before_ns
            self.line_ns, self.lost_ns = max(0, took_ns) // lines, min(0, took_ns)
        else:
            self.line_ns, self.lost_ns = period, self.lost_ns + lost * period

    def place(self, behind: int, period: Ns) -> Times:
        """Return the times of the next line of the last read, `behind` lines before its end."""
        took_ns = self.line_ns + self.lost_ns
        dt_ns, self.lost_ns = max(0, took_ns), min(0, took_ns)
        return self.expected_ns - behind * period, dt_ns, max(0, dt_ns - period)

    def skip(self) -> None:
        """Skip a line that is not used."""
        self.lost_ns += self.line_ns


class Prompted(Struct):
    """The lines of a board that answers commands, in their order."""

    answered: Ns = 0  # the last command
    sample_ns: Ns = 0  # of the last line, as the time of a command
    least: float = 0.0  # delay of a reply, ns; 0 if unknown
    own: float = 0.0  # ns of the last read's delay that is the board's own
    jitter: float = 0.0  # ns that the delay varies, without the board's own
    lateness: Lateness = field(default_factory=Lateness)

    def process_read(self, out: Output, end_ns: Ns, lines: int, soonest: Ns, period: Ns) -> None:
        """Process a read of replies that do not name their commands, one in each `period`."""
        waiting, given_up, lateness, last = out.open, out.given_up, self.lateness, lines - 1
        self.own = 0.0
        if lines == 1 and len(waiting) == 1 and self.least and not given_up:
            self.measure(end_ns - waiting[0].at_ns, 1, period)  # it answers the only command
            return
        while given_up and len(waiting) < lines:
            out.take_back()
        if len(waiting) < lines:
            return
        if not self.least:
            # The first reply answers the newest command that it can answer.
            while len(waiting) > lines and end_ns - waiting[lines].at_ns >= soonest:
                out.give_up()
            self.least = float(max(soonest, end_ns - waiting[last].at_ns))
        late = (end_ns - waiting[last].at_ns - self.least) / period
        while given_up and (late < -EARLY_REPLY or end_ns - waiting[last].at_ns < soonest):
            out.take_back()
            late = (end_ns - waiting[last].at_ns - self.least) / period
        possible = end_ns - max(self.least - USB_JITTER_NS, soonest)
        while (
            len(waiting) > lines
            and waiting[lines].at_ns <= possible
            and lateness.missing(late, lines, period)
        ):
            out.give_up()
            late = (end_ns - waiting[last].at_ns - self.least) / period
        self.measure(end_ns - waiting[last].at_ns, lines, period)

    def measure(self, delay: Ns, lines: int, period: Ns) -> None:
        """Measure the delay of the last reply of a read."""
        lateness, least = self.lateness, self.least or float(delay)
        longer = delay - least
        late = longer / period
        if longer < 0.0:
            self.least = float(delay)
        else:
            self.least = least + LEAST_DELAY_GAIN * (longer if longer < period else period)
        off, deviation = late - lateness.usual, lateness.deviation
        lateness.follow(late)
        jitter = deviation * period
        narrow = deviation < NARROW_DEVIATION and USB_JITTER_NS < jitter < ADAPTER_JITTER_NS
        self.jitter = USB_JITTER_NS if narrow else jitter
        if lines == 1 and narrow and abs(off) < 4 * deviation:
            self.own = off * period * (1.0 - (USB_JITTER_NS / jitter) ** 2)

    def place(self, out: Output, end_ns: Ns, asked_ns: Ns | None, period: Ns) -> Times:
        """Return the times of the next reply, to the command of `asked_ns` if it says so."""
        waiting, given_up, before = out.open, out.given_up, self.sample_ns
        usual = self.least + self.lateness.usual * period
        if asked_ns is not None:
            while waiting and waiting[0].at_ns < asked_ns:
                out.give_up()
            if waiting and waiting[0].at_ns == asked_ns:
                waiting.pop(0)
            command = asked_ns
        elif waiting:
            command = waiting.pop(0).at_ns
        else:
            # No command waits: this one answers none, or one that was given up.
            command = end_ns - int(usual)
            if out.newest_ns:
                command = min(command, out.newest_ns + period)
        sample_ns = command + int(self.own)
        if sample_ns < before:
            sample_ns = before
        dt_ns, bridged_ns = sample_ns - before if before else 0, 0
        if given_up and before and given_up[-1].at_ns > self.answered:
            bridged_ns = min(max(given_up[-1].at_ns - before, 0), dt_ns)
        self.answered, self.sample_ns, self.own = command, sample_ns, 0.0
        return sample_ns + int(usual), dt_ns, bridged_ns
