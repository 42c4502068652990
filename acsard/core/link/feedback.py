"""Adds to each good line its sample time and the motion since the previous good line.

The sample time is the time at which the board read its encoders. The time between two samples comes
from the best of these clocks that is available:

- the board's own clock, if its replies contain the time of this clock and the encoder counts;
- the times at which the commands were written, if the board answers each line (`PromptedTimes`);
- the period of the board, if the board reports by its own clock (`FreeRunningTimes`);
- otherwise the times at which the host read the lines, spread evenly if one read has several lines.

`ReplyStyle` detects whether the board answers each command or reports by its own clock. The sample
times do not affect the state of the link, which depends only on arrival times.
"""

from __future__ import annotations

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.settings import McuConfig
from acsard.core.config.wire_time import PLAIN_BYTES, wire_ns
from acsard.core.link.checked_line import Reading
from acsard.core.link.codec import Codec, Motors
from acsard.core.link.encoders import Encoders, Turned
from acsard.core.link.link_state import WATCHDOG_NS
from acsard.core.link.sample_time import MAX_FILLED_GAP_S, FreeRunningTimes, Placed, PromptedTimes
from acsard.core.values import NS_PER_S, Instant, WheelSpeeds

MIN_INTERVAL_NS = 1000
"""Least difference between the sample times of two successive lines, ns. Two lines with equal
sample times would look like a single line."""

DIFFERENCE_GAIN = 0.05
"""Gain of the filter for a mean difference: the time that `PromptedTimes` gives to a line, minus
the time that `FreeRunningTimes` gives to the same line."""

FULL_READ_BYTES = 1024
"""Least number of bytes in a full read of the port. After a full read, the kernel may hold more
data."""

EVALUATION_START = 1.5
"""Least difference between the number of reply periods and the number of written commands since the
previous read of the port. If a read reaches this difference, `ReplyStyle` begins to evaluate reads,
because scheduling alone causes a smaller difference."""

DECISION_DIFFERENCE = 2.5
"""Least difference between the number of reply periods and the number of commands at which
`ReplyStyle` decides. It decides whether the board reports by its own clock. Both numbers are sums
over the reads of the port that `ReplyStyle` evaluates."""

MAX_READ_PERIODS = 100.0
"""If more reply periods than this lie between two reads of the port, `ReplyStyle` does not evaluate
the later read."""

CLEAR_FRACTION = 0.5
"""Limit for how clearly the lines must favor one kind of board before `ReplyStyle` decides. Let n
be the number of received lines, p the number of reply periods, and c the number of commands, summed
over the reads of the port that `ReplyStyle` evaluates. Then |p - n| and |c - n| must differ by at
least `CLEAR_FRACTION` times |p - c|. This means that n is clearly nearer to p or to c."""

EXTRA_READS = 3
"""Number of further reads that `ReplyStyle` evaluates after a read of the port that reaches
`EVALUATION_START`."""

NEAR_FRACTION = 0.35
"""Limit for the number of lines that may be missing when `ReplyStyle` decides. Let n be the number
of received lines, p the number of reply periods, and c the number of commands, summed over the
reads of the port that `ReplyStyle` evaluates. The smaller of |p - n| and |c - n| must be at most
`NEAR_FRACTION` times n, or at most 1.5. The limit is not 0, because some lines get lost."""


class Feedback(Struct, frozen=True, gc=False):
    """A good line from the board, with its sample time and the motion since the previous good line.

    `at` is the time at which the board read its encoders, and `dt` is the time since the previous
    sample, s. If the motion since the previous sample is unknown, `dt` is 0, and `gap` is the time
    since the previous line, s. Otherwise `gap` is 0. For the first line of the board, both are 0.

    `turned` is the angle by which each wheel turned since the previous line, rad, in `WHEELS`
    order. It is computed from the encoder counts in the lines, so it is valid even after a gap. It
    is None if the angles are unknown.
    """

    at: Instant
    speeds: WheelSpeeds
    dt: float
    gap: float = 0.0
    turned: Motors | None = None
    bridged: float = 0.0
    """The part of the time since the previous sample in which lines were lost, s; 0 if no line was
    lost. This part comes first. The odometry fills it with the speeds of the last line before it
    and of the first line after it."""
    asked_ns: int | None = None
    """Monotonic time at which the daemon wrote the command that this line answers, ns. None if
    unknown."""
    since: float = 0.0
    """Time since the previous line for the plausibility checks, s. It comes from the board's clock
    if the line contains the time of that clock, else from the arrival times. It is 0 after a
    silence or a gap."""
    heard_ns: int = 0
    """Monotonic time at which the host had received the complete line, ns."""
    counted: Motors | None = None
    """Angle that each wheel turned since the previous sample, rad, in `WHEELS` order, without the
    time in which lines were lost (`bridged`). `whole_counts.py` recovers the angle from the speeds.
    None if the counts per turn are not configured, or if the firmware does not report whole
    counts."""
    steps: Motors = (0.0, 0.0, 0.0, 0.0)
    """Quantization step of each wheel's reported speed, rad/s, `math.inf` if unknown."""
    count: float = 0.0
    """Angle of one encoder count, rad, 0 if the counts per turn are not configured."""
    driven: float = 0.0
    """Time from the previous sample to the end of the last command to move, s. A command to move
    ends with the first line of zeros. It also ends when the watchdog of the board stops the motors
    because no line has reached the board. The value is negative if the command ended before the
    previous sample, and 0 in the first line."""


class ReplyStyle:
    """Detector of whether the board reports by its own clock or answers the daemon's lines.

    While the daemon sends one line per period, both kinds of boards look alike. Sometimes the
    daemon sends more or fewer lines, because the host did not run or because a new command did not
    wait for the next period. Then a board that reports by its own clock sends as many lines as
    periods have passed. A board that answers sends as many lines as it received commands. The class
    compares the number of received lines with both numbers.
    """

    def __init__(self, free_running: bool) -> None:
        """Start before the first read of the port.

        `free_running` is true if `mcu.reply_period` is set, so that the board certainly reports by
        its own clock. If `free_running` is false, the kind of the board is unknown at first.
        """
        self.speaks: bool | None = free_running or None
        """True if the board reports by its own clock, False if it answers each command, None while
        unknown."""
        self._known = free_running
        self._left = self._after = 0
        self._came = self._periods = self._asked = 0.0

    def written(self) -> None:
        """Count a command that was written to the port."""
        self._left += 1

    def process_read(self, lines: int, periods: float) -> None:
        """Process a read of the port that completed `lines` lines.

        `periods` is the time since the previous read that completed a line, in reply periods of the
        board.
        """
        left, self._left = self._left, 0
        if self._known or periods > MAX_READ_PERIODS:
            return
        if abs(periods - left) >= EVALUATION_START:
            self._after = EXTRA_READS
        elif self._after:
            self._after -= 1
        else:
            return
        self._came += lines
        self._periods += periods
        self._asked += left
        line_count, own, asked = (
            self._came,
            abs(self._came - self._periods),
            abs(self._came - self._asked),
        )
        apart = abs(self._periods - self._asked)
        if apart < DECISION_DIFFERENCE or abs(own - asked) < CLEAR_FRACTION * apart:
            return
        if min(own, asked) <= max(1.5, NEAR_FRACTION * line_count):
            self.speaks = own < asked
        self._came = self._periods = self._asked = 0.0
        self._after = 0


class Timeline:
    """Assigns a sample time to each good line, in order.

    For each read of the port, call `process_read`. Then, for each line of the read in order, call
    `place` if the line is good and `skip_bad` if it is bad.
    """

    def __init__(
        self, mcu: McuConfig, codec: Codec, wheel_speed: float, quiet_ns: int, rate_hz: float
    ) -> None:
        """Start before the first line from the board.

        `codec` maps the motors to the wheels. `wheel_speed` is the highest speed that a wheel can
        have, rad/s. `quiet_ns` is the duration of silence after which the link is stale, ns.
        `rate_hz` is the daemon's control rate.
        """
        self._codec, self._baud_rate, self._quiet_ns = codec, mcu.baud_rate, quiet_ns
        self._encoders = Encoders(mcu.encoder_counts, wheel_speed, quiet_ns)
        self._counts = mcu.encoder_counts
        known = (mcu.reply_period,) if mcu.reply_period else ()
        self._slots = FreeRunningTimes((*known, 1 / rate_hz))
        self._period_ns = NS_PER_S * (mcu.reply_period or 1 / rate_hz)
        self._prompts = PromptedTimes(wire_ns(2 * PLAIN_BYTES, mcu.baud_rate))
        self._style = ReplyStyle(mcu.reply_period > 0)
        self._last: Instant | None = None
        self._heard_ns = self._end_ns = 0
        self._forgotten = True
        self._rest_ns = 0
        """Monotonic time at which the last command to move ends, ns: the time of the first line of
        zeros, or of the stop by the board's watchdog if that is earlier."""
        self._last_placed = Placed("reads", 0)
        """The time of the last good line, by the clock that was chosen for this line."""
        self._spoilt = False
        """Whether a bad or ignored line came since the last good line."""
        self._later = 0.0
        """Mean difference between two times of the same line, ns: the time that `PromptedTimes`
        gives minus the time that `FreeRunningTimes` gives."""
        self._compared = False
        """Whether the mean in `_later` includes the last difference. If it does not, the next
        difference becomes the new mean."""
        self.leaps = 0
        """Number of lines with impossible encoder counts. For such a line, the angle that a wheel
        turned is computed as speed times time."""
        self.restarted = False
        """Whether the board's clock in the last line shows that the board has restarted."""

    def forget(self) -> None:
        """Forget the previous line, because a new session begins.

        The motion between the previous line and the next one is then unknown.
        """
        self._encoders.forget()
        self._slots.forget()
        self._prompts.forget()
        self._forgotten = True

    def written(self, at_ns: int, moves: bool = True) -> None:
        """Record that a command was written at the monotonic time `at_ns`, ns.

        `moves` is true if the command contains a speed other than zero.
        """
        self._prompts.written(at_ns)
        self._style.written()
        self._rest_ns = at_ns + WATCHDOG_NS if moves else min(self._rest_ns, at_ns)

    def process_read(self, at: Instant, size: int, lines: int, following: int) -> None:
        """Process a read of the port that completes at least one line.

        `at` is the time of the read, `size` is its number of bytes, and `lines` is the number of
        lines that it completes. `following` is the number of bytes in the read after the end of the
        last of these lines.
        """
        before, end_ns = self._end_ns, at.mono_ns
        if following:
            end_ns -= wire_ns(following, self._baud_rate)
        end_ns = self._end_ns = end_ns if end_ns > before else before
        self._at, self._rest = at, lines
        self._share_ns = (end_ns - before) / lines
        style, slots = self._style, self._slots
        if style.speaks is not False:
            slots.process_read(end_ns, lines, size < FULL_READ_BYTES)
        spoke = style.speaks
        style.process_read(lines, (end_ns - before) / self._usual_ns)
        if style.speaks is False:
            slots.forget()
            if spoke and self._last_placed.clock != "prompts":
                # While the board seemed to report by itself, no reply was assigned to a command.
                self._prompts.restart()
        self._prompts.process_read(end_ns, lines, following > 0)

    def skip_bad(self) -> None:
        """Skip the next line of the read, because this line is bad.

        Also skip the command that this line may answer, unless the board reports by its own clock.
        """
        self._rest -= 1
        self._spoilt = True
        if not self._style.speaks:
            self._prompts.skip()

    def place(
        self,
        speeds: WheelSpeeds,
        reading: Reading | None,
        following: int,
        length: int,
        silent: bool,
        asked_ns: int | None = None,
    ) -> Feedback:
        """Return the feedback for the next line of the read, which must be a good line.

        Args:
            speeds: wheel speeds in the line.
            reading: sample fields of a checked reply; None if the line has no sample fields.
            following: number of bytes in the read after the end of the line.
            length: number of bytes of the line with its line end.
            silent: whether the line ends a silence of more than `quiet_ns`, or is the first good
                line since the port was opened or the board restarted.
            asked_ns: monotonic time at which the answered command was written, ns; None if unknown.
        """
        self._rest -= 1
        # Bytes that followed in the same read were on the wire after this line was complete.
        came_ns = self._at.mono_ns
        if following:
            came_ns -= wire_ns(following, self._baud_rate)
        before_ns = self._heard_ns
        came_ns = came_ns if came_ns > before_ns else before_ns
        since, self._heard_ns = (came_ns - before_ns) / NS_PER_S, came_ns
        placed = self._placed(asked_ns, came_ns)
        dt, bridged = self._since_last(placed)
        self._spoilt = False
        first = self._last is None
        turned, wheels = self._turned(reading, came_ns), None
        # A board that answers lines sends nothing by itself, so no line is missing after a time in
        # which the host sent nothing.
        clocked = placed.clock != "reads" or self._prompts.lossy
        known = clocked or not silent or dt * NS_PER_S <= self._quiet_ns
        if turned is not None:
            dt, bridged, since, known = turned.dt, 0.0, turned.dt, not silent
            wheels = self._codec.wheels(turned.motors)
        gap = 0.0
        if self._forgotten or self.restarted or not known or dt >= MAX_FILLED_GAP_S:
            gap = 0.0 if first else max(since, dt)
            self._share_ns = min(self._share_ns, wire_ns(length, self._baud_rate))
            self._last_placed = self._placed_by_reads() if placed.clock == "reads" else placed
            dt = bridged = since = 0.0
        self._forgotten = False
        driven = 0.0 if self._last is None else (self._rest_ns - self._last.mono_ns) / NS_PER_S
        at = self._sampled(came_ns, self._last_placed, length)
        since = 0.0 if silent else since
        return Feedback(
            at, speeds, dt, gap, wheels, bridged, asked_ns, since, came_ns, driven=driven
        )

    def _placed(self, asked_ns: int | None, came_ns: int) -> Placed:
        """Return the time of the next line by the best available clock."""
        speaks, answered = self._style.speaks, None
        if asked_ns is not None or not speaks:
            answered = self._prompts.place(asked_ns)
            ours = asked_ns is not None or speaks is False or self._prompts.varies_delay
            if ours and answered is not None:
                if asked_ns is None and answered.due_ns - came_ns > self._usual_ns / 2:
                    # The usual delay is too long: it was measured on the first reply, which a stall
                    # had delayed. The time of the previous line already includes that stall, so the
                    # time of this line is its arrival.
                    return Placed("prompts", came_ns, early=True)
                return answered
        slot = self._slots.place(self._rest)
        if slot is None:
            placed, latest_ns = self._placed_by_reads(), self._prompts.latest_ns
            if speaks is False and latest_ns and latest_ns + self._usual_ns < placed.due_ns:
                # This reply waited in a stall, and its command was taken for a lost one. A board
                # that only answers took its sample when the last command arrived, or before.
                placed = replace(placed, due_ns=latest_ns)
            return placed
        if answered is not None:
            self._compare(answered, slot)
        return slot if slot.due_ns <= came_ns else replace(slot, due_ns=came_ns)

    def _placed_by_reads(self) -> Placed:
        return Placed("reads", int(self._end_ns - self._share_ns * self._rest))

    def _since_last(self, placed: Placed) -> tuple[float, float]:
        """Return the time since the last good line, and the part of it in which lines were lost.

        Both are in s. `placed` is the time of the present line.
        """
        last = self._last_placed
        back = placed.due_ns < last.due_ns
        self._last_placed = replace(placed, due_ns=last.due_ns) if back else placed
        # If the times of this line and of the last good line come from different clocks, their
        # difference is corrected by the mean offset between the clocks. Without this correction,
        # the errors of many changes from one clock to another would add up.
        by_clock = placed.dt if placed.clock == last.clock else None
        if by_clock is not None and not last.early:
            return by_clock, placed.bridged
        late_ns = self._late_ns(placed.clock) - self._late_ns(last.clock)
        dt = max(0.0, (placed.due_ns - last.due_ns - late_ns) / NS_PER_S)
        if by_clock is not None:
            return dt, placed.bridged
        period = self._usual_ns / NS_PER_S
        # A prompted board only answers commands, so a long time alone does not show that lines
        # are missing. But if a reply was bad or ignored, the speeds for a part of this time are
        # missing.
        missing = dt > 1.5 * period and (self._style.speaks is not False or self._spoilt)
        return dt, dt - period if missing else 0.0

    def _compare(self, answered: Placed, slot: Placed) -> None:
        later_ns = answered.due_ns - slot.due_ns
        if abs(later_ns) > self._quiet_ns / 4:
            # After a stall, the line may answer another command than the oldest one.
            self._compared = False
            return
        if slot.dt is None or self._last_placed.clock != "slots" or not self._compared:
            self._later, self._compared = float(later_ns), True
        self._later += DIFFERENCE_GAIN * (later_ns - self._later)

    def _late_ns(self, clock: str) -> float:
        """Return by how much a clock gives later times than `FreeRunningTimes`, on average, ns.

        `clock` is "reads", "prompts" or "slots". The caller needs this offset to subtract the times
        of two lines that come from different clocks.
        """
        if clock == "reads":
            return self._slots.late_ns
        return self._later if clock == "prompts" else 0.0

    @property
    def _usual_ns(self) -> float:
        return self._slots.usual or self._period_ns

    def _sampled(self, came_ns: int, placed: Placed, length: int) -> Instant:
        """Return the sample time of the line: the time at which the board began to send it.

        `placed` is the time at which the host should have received the line, and `came_ns` the time
        at which the line came. `length` is the number of bytes of the line.
        """
        mono_ns = min(came_ns, placed.due_ns) - wire_ns(length, self._baud_rate)
        last, read = self._last, self._at
        wall_ns = read.wall_ns - read.mono_ns + mono_ns
        if last is not None and mono_ns < last.mono_ns + MIN_INTERVAL_NS:
            late_ns = last.mono_ns + MIN_INTERVAL_NS - mono_ns
            mono_ns, wall_ns = (
                mono_ns + late_ns,
                max(wall_ns + late_ns, last.wall_ns + MIN_INTERVAL_NS),
            )
        self._last = Instant(mono_ns, wall_ns)
        return self._last

    def _turned(self, reading: Reading | None, at_ns: int) -> Turned | None:
        self.restarted = False
        if reading is None or not self._counts:
            self._encoders.forget()
            return None
        turned = self._encoders.turned(reading, at_ns)
        if isinstance(turned, Turned):
            return turned
        self.restarted = turned == "restarted"
        self.leaps += turned == "leap"
        return None
