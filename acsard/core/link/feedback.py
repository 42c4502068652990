"""Adds to each good line its sample time and the motion since the previous good line.

The sample time is when the board read its encoders. It comes from the board's own clock, if it
sends its counts; from the times of the commands, if it answers each line (`PromptedTimes`); from
its period, if `mcu.reply_period` declares a free-running board (`FreeRunningTimes`); or, until
these are known, from the times of the reads, spread evenly over their lines. A checked reply names
its line, so its board is a prompted one. The state of the link depends only on arrival times.
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

FULL_READ_BYTES = 1024  # after a full read, the kernel may hold more data


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
        self._period_ns = NS_PER_S * (mcu.reply_period or 1 / rate_hz)
        self._slots: FreeRunningTimes | None = None
        self._prompts: PromptedTimes | None = None
        if mcu.reply_period and not mcu.checked:
            self._slots = FreeRunningTimes((mcu.reply_period,))
        else:
            self._prompts = PromptedTimes(wire_ns(2 * PLAIN_BYTES, mcu.baud_rate))
        self._last: Instant | None = None
        self._heard_ns = self._end_ns = 0
        self._forgotten = True
        self._rest_ns = 0  # the last command to move ended: zeros, or the board's watchdog
        self._last_placed = Placed("reads", 0)  # by the clock that was chosen
        self._spoilt = False  # a bad or ignored line came since the last good one
        self.leaps = 0  # lines with impossible counts, for which speed times time is used
        self.restarted = False  # by the board's clock in the last line

    def forget(self) -> None:
        self._encoders.forget()
        if self._slots:
            self._slots.forget()
        if self._prompts:
            self._prompts.forget()
        self._forgotten = True

    def written(self, at_ns: Ns, moves: bool = True) -> None:
        """Record a command that was written; `moves` if a speed in it is not zero."""
        if self._prompts:
            self._prompts.written(at_ns)
        self._rest_ns = at_ns + WATCHDOG_NS if moves else min(self._rest_ns, at_ns)

    def process_read(self, at: Instant, size: int, lines: int, following: int) -> None:
        """Process a read that completes `lines`, with `following` bytes after them."""
        before, end_ns = self._end_ns, at.mono_ns
        if following:
            end_ns -= wire_ns(following, self._baud_rate)
        end_ns = self._end_ns = end_ns if end_ns > before else before
        self._at, self._rest = at, lines
        self._share_ns = (end_ns - before) / lines
        if self._slots:
            self._slots.process_read(end_ns, lines, size < FULL_READ_BYTES)
        if self._prompts:
            self._prompts.process_read(end_ns, lines, following > 0)

    def skip_bad(self) -> None:
        """Skip a bad line, and the command that it may answer if the board has no own clock."""
        self._rest -= 1
        self._spoilt = True
        if self._prompts:
            self._prompts.skip()

    def skip_repeated(self) -> None:
        """Skip a line that repeats the previous one."""
        self._rest -= 1

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
        lossy = self._prompts is not None and self._prompts.lossy
        clocked = placed.clock != "reads" or lossy
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
        if self._slots:
            placed = self._slots.place(self._rest)
            if placed is None:
                return self._placed_by_reads()
            return placed if placed.due_ns <= came_ns else replace(placed, due_ns=came_ns)
        assert self._prompts
        placed = self._prompts.place(asked_ns)
        if placed is None:
            placed, latest_ns = self._placed_by_reads(), self._prompts.latest_ns
            if latest_ns and latest_ns + self._period_ns < placed.due_ns:
                # This reply waited in a stall, and its command was taken for a lost one. The board
                # took its sample when the last command arrived, or before.
                return replace(placed, due_ns=latest_ns)
            return placed
        if asked_ns is None and placed.due_ns - came_ns > self._period_ns / 2:
            # The usual delay was measured on a first reply that a stall had delayed. The previous
            # line's time has that stall in it, so this one's is its arrival.
            return Placed("prompts", came_ns, early=True)
        return placed

    def _placed_by_reads(self) -> Placed:
        return Placed("reads", int(self._end_ns - self._share_ns * self._rest))

    def _since_last(self, placed: Placed) -> tuple[float, float]:
        last = self._last_placed
        back = placed.due_ns < last.due_ns
        self._last_placed = replace(placed, due_ns=last.due_ns) if back else placed
        by_clock = placed.dt if placed.clock == last.clock else None
        if by_clock is not None and not last.early:
            return by_clock, placed.bridged
        # The times of reads are later than those of the slots: these errors would add up.
        late = {"reads": self._slots.late_ns} if self._slots else {}
        late_ns = late.get(placed.clock, 0.0) - late.get(last.clock, 0.0)
        dt = max(0.0, (placed.due_ns - last.due_ns - late_ns) / NS_PER_S)
        if by_clock is not None:
            return dt, placed.bridged
        period = self._usual_ns / NS_PER_S
        # A long time alone does not show that lines of a prompted board are missing. But after a
        # bad or ignored reply, the speeds for a part of it are.
        missing = dt > 1.5 * period and (self._slots is not None or self._spoilt)
        return dt, dt - period if missing else 0.0

    @property
    def _usual_ns(self) -> float:
        return (self._slots.usual if self._slots else 0.0) or self._period_ns

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
