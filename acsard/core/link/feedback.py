"""Adds to each good line its sample time and the motion since the previous good line.

The sample time is when the board read its encoders, by `line_times.py`. If the line has the board's
counts and its clock, the motion is that of the counts. The state of the link depends only on
arrival times.
"""

from __future__ import annotations

from msgspec import Struct, field

from acsard.core.config.wire_time import wire_ns
from acsard.core.link.board_counts import CountsCheck, Encoders, Turned
from acsard.core.link.checked_line import Reading
from acsard.core.link.coarse_encoders import CoarseEncoders
from acsard.core.link.line_times import (
    MAX_ADAPTER_DELAY_NS,
    USB_JITTER_NS,
    FreeRunning,
    Prompted,
)
from acsard.core.link.link_output import Output
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.whole_counts import WholeCounts
from acsard.core.values import NS_PER_S, Instant, Ns, Rad, RadPerS, Seconds, Wheels4, WheelSpeeds

# Only shorter gaps are filled: the board may have been reset in a longer one.
MAX_FILLED_GAP_S = 1.0

MIN_INTERVAL_NS = 1000  # two lines with equal sample times would look like one

FULL_READ_BYTES = 1024  # after a full read, the kernel may hold more data


class Line(Struct, frozen=True, gc=False):
    """A good line from the board, with its sample time and the motion since the previous good line.

    `dt` and `gap` are times since the previous line: `gap` if the motion is unknown, else `dt`;
    both are 0 in the first line. `turned` is the angle of each wheel by the board's counts, valid
    even after a gap. `counted` is that of whole counts in the speeds (`whole_counts.py`), without
    the time of `bridged`. Both are None if they are unknown.
    """

    at: Instant
    speeds: WheelSpeeds
    dt: Seconds
    gap: Seconds = 0.0
    turned: Wheels4 | None = None
    # Of `dt`, in which lines were lost. It comes first, and the odometry fills it.
    bridged: Seconds = 0.0
    # Of the rest of `dt`, which the line may not cover: its board may report its last instant.
    vague: Seconds = 0.0
    # By how much later than when it was due the line came, less that of the line before it.
    late: Seconds = 0.0
    counted: Wheels4 | None = None
    count: Rad = 0.0  # angle of one count; 0 if it is not declared, or seems wrong
    step: RadPerS = 0.0  # change of a speed that one count explains; inf if unknown
    since: Seconds = 0.0  # by the board's clock or arrivals, for plausibility; 0 after a gap
    # From the previous sample to the end of the last command to move: the first line of zeros, or
    # the board's watchdog. It is negative if that was before the sample.
    driven: Seconds = 0.0
    # Angles of this line and earlier ones, by which counts and speeds contradict each other, rad.
    doubt: Wheels4 | None = None
    asked_ns: Ns | None = None  # when the answered command was written
    heard_ns: Ns = 0  # the host had the complete line

    @property
    def by_counts(self) -> Wheels4 | None:
        """The angle of each wheel since the previous line, if the line shows counts."""
        return self.counted if self.turned is None else self.turned


class Timeline(Struct):
    """Assigns a sample time to each good line, in order.

    For each read call `process_read`, then for each line `place` if it is good, or `skip_bad`.
    """

    free_running: FreeRunning = field(default_factory=FreeRunning)
    prompted: Prompted = field(default_factory=Prompted)
    encoders: Encoders = field(default_factory=Encoders)
    whole: WholeCounts = field(default_factory=WholeCounts)
    coarse: CoarseEncoders = field(default_factory=CoarseEncoders)
    begun: bool = False  # a line was placed since `forget`
    read: Instant = Instant(0, 0)  # the last one
    end_ns: Ns = 0  # its last line was complete
    rest: int = 0  # its lines that follow
    read_lines: int = 0
    heard_ns: Ns = 0  # the last line was complete
    last: Instant | None = None  # sample time of the last line
    # By which the last line was made later than due, and came later.
    shifted_ns: Ns = 0
    held_ns: Ns = 0
    burst_ns: Ns = 0  # since the first one of the lines that came without a pause
    counts_check: CountsCheck = field(default_factory=CountsCheck)
    gaps: int = 0  # lines behind lost ones
    leaps: int = 0  # lines with impossible counts, for which speed times time is used
    restarted: bool = False  # by the board's clock in the last line

    def forget(self) -> None:
        """Forget the lines before: the board may be another one."""
        self.free_running = FreeRunning()
        self.prompted = Prompted()
        self.encoders.forget()
        self.whole = WholeCounts()
        self.coarse.forget()
        self.counts_check = CountsCheck()
        self.shifted_ns = self.held_ns = self.burst_ns = 0
        self.begun = False

    def process_read(
        self, setup: LinkSetup, out: Output, at: Instant, size: int, lines: int, following: int
    ) -> None:
        """Process a read that completes `lines`, with `following` bytes after them."""
        before, end_ns = self.end_ns, at.mono_ns
        if following:
            end_ns -= wire_ns(following, setup.mcu.baud_rate)
        end_ns = self.end_ns = end_ns if end_ns > before else before
        self.read, self.rest, self.read_lines = at, lines, lines
        if setup.period_ns:
            drained = size < FULL_READ_BYTES
            since = end_ns - before
            self.free_running.process_read(end_ns, since, lines, drained, setup.period_ns)
        elif not setup.mcu.checked:
            self.prompted.process_read(
                out, end_ns, lines, setup.soonest_ns, setup.command_interval_ns
            )

    def skip_bad(self, setup: LinkSetup, out: Output) -> None:
        """Skip a line that is not used, and the command that it may answer, or its period."""
        self.rest -= 1
        if setup.period_ns:
            self.free_running.skip()
        elif not setup.mcu.checked:  # else the next reply names its command
            out.give_up()

    def place(
        self,
        setup: LinkSetup,
        out: Output,
        speeds: WheelSpeeds,
        reading: Reading | None,
        following: int,
        length: int,
        silent: bool,
        asked_ns: Ns | None = None,
        waited_ns: Ns = 0,
    ) -> Line:
        """Return the next line of the read, which must be a good one.

        `following` bytes of the read come after it, and `length` is its own with its end. `silent`
        says that it ends a silence, or is the first since the opening or a restart. It waited for
        this computer for at most `waited_ns`.
        """
        self.rest -= 1
        # Bytes that followed in the same read were on the wire after this line was complete.
        came_ns, before_ns, last = self.read.mono_ns, self.heard_ns, self.last
        if following:
            came_ns -= wire_ns(following, setup.mcu.baud_rate)
        came_ns = self.heard_ns = came_ns if came_ns > before_ns else before_ns
        since = (came_ns - before_ns) / NS_PER_S
        if setup.period_ns:
            expected_ns, dt_ns, bridged_ns = self.free_running.place(self.rest, setup.period_ns)
        else:
            if asked_ns is not None and not self.rest:
                self.prompted.measure(
                    self.end_ns - asked_ns, self.read_lines, setup.command_interval_ns
                )
            expected_ns, dt_ns, bridged_ns = self.prompted.place(
                out, self.end_ns, asked_ns, setup.command_interval_ns
            )
        if came_ns - before_ns <= wire_ns(length, setup.mcu.baud_rate) + USB_JITTER_NS:
            self.burst_ns += came_ns - before_ns  # it may have waited for the wire only
        else:
            self.burst_ns = 0
        held_ns = came_ns - self.burst_ns - expected_ns
        held_ns = held_ns if held_ns < 0 else max(0, held_ns - waited_ns)
        by_board, self.restarted = None, False
        if reading is not None and setup.count:
            by_board = self._turned(setup, reading, came_ns)
        elif self.encoders.last is not None:
            self.encoders.forget()
        shift_ns, late_ns = self._shift(held_ns, dt_ns, by_board)
        bridged_ns = max(0, bridged_ns + min(0, shift_ns))  # the time is in a line before it
        dt, bridged, gap = (dt_ns + shift_ns) / NS_PER_S, bridged_ns / NS_PER_S, 0.0
        late = late_ns / NS_PER_S
        known, turned, doubt = self.begun, None, None
        if bridged > 0.0:
            self.gaps += 1
        if by_board is not None:
            check, by_counts = self.counts_check, setup.codec.wheels(by_board.motors)
            dt = since = by_board.dt
            if not bridged and dt <= setup.covered_s:
                doubt = check.add(by_counts, speeds.as_tuple(), dt, setup.count)
            bridged, known, turned, late = 0.0, known and not silent, by_counts, 0.0
        if not known or self.restarted or dt >= MAX_FILLED_GAP_S:
            gap = 0.0 if last is None else max(since, dt)
            dt = bridged = since = late = 0.0
        self.begun = True
        elapsed, wheels, counted, count = dt - bridged, speeds.as_tuple(), None, 0.0
        if setup.count and not self.counts_check.scaled:
            count = setup.count
            step = count / elapsed if elapsed > 0.0 else 0.0
            if turned is None and elapsed > 0.0 and setup.shows_counts:
                # The time of a free-running board has no error.
                jitter = 0.0 if setup.period_ns else int(self.prompted.jitter) / NS_PER_S
                counted = self.whole.turned(count, wheels, elapsed, jitter, bridged)
                if self.whole.covers_gap:
                    bridged = 0.0
            else:
                self.whole.carried = 0.0
        else:
            step = self.coarse.step(wheels, elapsed, len(setup.codec.letters))
        vague = 0.0
        if turned is None and elapsed > setup.covered_s:
            vague = elapsed - setup.line_s
        expected_ns += self.shifted_ns
        expected_ns = expected_ns if expected_ns < came_ns else came_ns
        # Pass the fields by position: creating a struct by its names takes three times as long.
        return Line(
            self._sampled(expected_ns - wire_ns(length, setup.mcu.baud_rate)),
            speeds,
            dt,
            gap,
            turned,
            bridged,
            vague,
            late,
            counted,
            count,
            step,
            0.0 if silent else since,
            0.0 if last is None else (out.rest_ns - last.mono_ns) / NS_PER_S,
            doubt,
            asked_ns,
            came_ns,
        )

    def _shift(self, held_ns: Ns, dt_ns: Ns, by_board: Turned | None) -> tuple[Ns, Ns]:
        # A line that came later than an adapter holds it was made when it came, unless the clock of
        # the board says when: firmware that blocks answers all that waits at once, and its first
        # answer has the motion of that time. The time between is a doubt. Returns by how much the
        # shift and this time have grown.
        shifted_ns, before_ns = self.shifted_ns, self.held_ns
        shift_ns = held_ns if held_ns > MAX_ADAPTER_DELAY_NS else 0
        if by_board is not None:
            shift_ns = min(shift_ns, max(0, shifted_ns + int(by_board.dt * NS_PER_S) - dt_ns))
        shift_ns = max(shift_ns, shifted_ns - dt_ns)  # not before the line before it
        self.shifted_ns, self.held_ns = shift_ns, held_ns
        return shift_ns - shifted_ns, self.held_ns - before_ns

    def _sampled(self, mono_ns: Ns) -> Instant:
        last, wall_ns = self.last, self.read.wall_ns - self.read.mono_ns + mono_ns
        if last is not None and mono_ns < last.mono_ns + MIN_INTERVAL_NS:
            late_ns = last.mono_ns + MIN_INTERVAL_NS - mono_ns
            mono_ns += late_ns
            wall_ns = max(wall_ns + late_ns, last.wall_ns + MIN_INTERVAL_NS)
        self.last = Instant(mono_ns, wall_ns)
        return self.last

    def _turned(self, setup: LinkSetup, reading: Reading, at_ns: Ns) -> Turned | None:
        turned = self.encoders.turned(setup, reading, at_ns)
        if isinstance(turned, Turned):
            return turned
        self.restarted = turned == "restarted"
        self.leaps += turned == "leap"
        return None
