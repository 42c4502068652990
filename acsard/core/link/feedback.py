"""Adds to each good line its sample time and the motion since the previous good line.

The sample time is when the board read its encoders. It comes from the best clock that is available:
the board's own (with its counts); the times of the commands, if the board answers each line
(`PromptedTimes`); the period of the board, if it reports by its own clock (`FreeRunningTimes`); or
the times of the reads, spread evenly over their lines. `ReplyStyle` finds out which kind of board
it is. The state of the link depends only on arrival times.
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
from acsard.core.values import NS_PER_S, Instant, Ns, WheelSpeeds

MIN_INTERVAL_NS = 1000  # two lines with equal sample times would look like one

DIFFERENCE_GAIN = 0.05  # of the mean difference between the two clocks of a line

FULL_READ_BYTES = 1024  # after a full read, the kernel may hold more data

# Least difference of reply periods and commands in an evaluated read; scheduling causes less.
EVALUATION_START = 1.5

DECISION_DIFFERENCE = 2.5  # the same, summed over evaluated reads, for a decision

MAX_READ_PERIODS = 100.0  # a read after more reply periods than this is not evaluated

# With n lines, p reply periods and c commands: ||p - n| - |c - n|| must reach this times |p - c|.
CLEAR_FRACTION = 0.5

EXTRA_READS = 3  # evaluated after a read that reaches `EVALUATION_START`

# The smaller of |p - n| and |c - n| must be at most this times n, or 1.5: some lines get lost.
NEAR_FRACTION = 0.35


class Feedback(Struct, frozen=True, gc=False):
    """A good line from the board, with its sample time and the motion since the previous good line.

    `dt` and `gap` are times since the previous line, s: `gap` if the motion is unknown, else `dt`;
    both are 0 in the first line. `turned` is the angle of each wheel by encoder counts, rad, valid
    even after a gap.
    """

    at: Instant
    speeds: WheelSpeeds
    dt: float
    gap: float = 0.0
    turned: Motors | None = None
    # s of `dt` in which lines were lost. It comes first, and the odometry fills it.
    bridged: float = 0.0
    asked_ns: Ns | None = None  # when the answered command was written
    since: float = 0.0  # s by the board's clock or arrivals, for plausibility; 0 after a gap
    heard_ns: Ns = 0  # the host had the complete line
    # Whole counts as angles, rad, without the time of `bridged` (`whole_counts.py`). None if the
    # counts per turn are unknown or the firmware does not report whole counts.
    counted: Motors | None = None
    steps: Motors = (0.0, 0.0, 0.0, 0.0)  # quantization of the speeds, rad/s; inf if unknown
    count: float = 0.0  # rad of one encoder count; 0 if unknown
    # From the previous sample to the end of the last command to move, s: the first line of zeros,
    # or the board's watchdog. It is negative if that was before the sample.
    driven: float = 0.0


class ReplyStyle:
    """Detects whether the board reports by its own clock or answers the daemon's lines.

    At one line per period, both look alike. When a stall or an early command changes that, a board
    with a clock sends as many lines as periods passed, and one that answers as many as it got
    commands. Both numbers are compared with the received lines.
    """

    def __init__(self, free_running: bool) -> None:
        # By its own clock, or by each command; None: unknown. `free_running`: `reply_period` > 0.
        self.speaks: bool | None = free_running or None
        self._known = free_running
        self._left = self._after = 0
        self._came = self._periods = self._asked = 0.0

    def written(self) -> None:
        self._left += 1

    def process_read(self, lines: int, periods: float) -> None:
        """Process a read that completed `lines`, `periods` reply periods after the previous one."""
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

    For each read call `process_read`, then for each line `place` if it is good, or `skip_bad`.
    """

    def __init__(
        self, mcu: McuConfig, codec: Codec, wheel_speed: float, quiet_ns: Ns, rate_hz: float
    ) -> None:
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
        self._rest_ns = 0  # the last command to move ended: zeros, or the board's watchdog
        self._last_placed = Placed("reads", 0)  # by the clock that was chosen
        self._spoilt = False  # a bad or ignored line came since the last good one
        self._later = 0.0  # mean time by `PromptedTimes` minus that by `FreeRunningTimes`, ns
        self._compared = False  # `_later` has the last difference; if not, the next replaces it
        self.leaps = 0  # lines with impossible counts, for which speed times time is used
        self.restarted = False  # by the board's clock in the last line

    def forget(self) -> None:
        self._encoders.forget()
        self._slots.forget()
        self._prompts.forget()
        self._forgotten = True

    def written(self, at_ns: Ns, moves: bool = True) -> None:
        """Record a command that was written; `moves` if a speed in it is not zero."""
        self._prompts.written(at_ns)
        self._style.written()
        self._rest_ns = at_ns + WATCHDOG_NS if moves else min(self._rest_ns, at_ns)

    def process_read(self, at: Instant, size: int, lines: int, following: int) -> None:
        """Process a read that completes `lines`, with `following` bytes after them."""
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
        """Skip a bad line, and the command that it may answer if the board has no own clock."""
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
        asked_ns: Ns | None = None,
    ) -> Feedback:
        """Return the feedback for the next line of the read, which must be a good one.

        `following` bytes of the read come after it, and `length` is its own with its end. `silent`
        says that it ends a silence, or is the first since the opening or a restart.
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
        # A board that answers sends nothing by itself, so after a pause no line is missing.
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

    def _placed(self, asked_ns: Ns | None, came_ns: Ns) -> Placed:
        speaks, answered = self._style.speaks, None
        if asked_ns is not None or not speaks:
            answered = self._prompts.place(asked_ns)
            ours = asked_ns is not None or speaks is False or self._prompts.varies_delay
            if ours and answered is not None:
                if asked_ns is None and answered.due_ns - came_ns > self._usual_ns / 2:
                    # The usual delay was measured on a first reply that a stall had delayed. The
                    # previous line's time has that stall in it, so this one's is its arrival.
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
        last = self._last_placed
        back = placed.due_ns < last.due_ns
        self._last_placed = replace(placed, due_ns=last.due_ns) if back else placed
        # Times of different clocks are corrected by the mean offset between the clocks. The errors
        # of many changes would add up otherwise.
        by_clock = placed.dt if placed.clock == last.clock else None
        if by_clock is not None and not last.early:
            return by_clock, placed.bridged
        late_ns = self._late_ns(placed.clock) - self._late_ns(last.clock)
        dt = max(0.0, (placed.due_ns - last.due_ns - late_ns) / NS_PER_S)
        if by_clock is not None:
            return dt, placed.bridged
        period = self._usual_ns / NS_PER_S
        # A long time alone does not show that lines of a prompted board are missing. But after a
        # bad or ignored reply, the speeds for a part of it are.
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
        if clock == "reads":
            return self._slots.late_ns
        return self._later if clock == "prompts" else 0.0

    @property
    def _usual_ns(self) -> float:
        return self._slots.usual or self._period_ns

    def _sampled(self, came_ns: Ns, placed: Placed, length: int) -> Instant:
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

    def _turned(self, reading: Reading | None, at_ns: Ns) -> Turned | None:
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
