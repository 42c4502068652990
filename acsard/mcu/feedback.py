"""A good line -> feedback: when its sample was made, and what the wheels did since the one before.

Whose clock says how far two lines are apart: the MCU's own where it sends it with its counts; the
lines that left where each is answered (`clock_of_answers.py`); the period of an MCU that reports by
itself (`clock_of_reports.py`, and which of the two it is: `habit.py`); else the reads, evenly over
the lines of one.
Whether the link can be trusted is `session.py`'s, by arrival alone.
"""

from __future__ import annotations

from typing import Literal

from msgspec import Struct
from msgspec.structs import replace

from acsard.config.settings import McuConfig
from acsard.config.wire_time import PLAIN_BYTES, wire_ns
from acsard.mcu.check import Reading
from acsard.mcu.clock_of_answers import Prompts
from acsard.mcu.clock_of_reports import Slots
from acsard.mcu.codec import Codec, Motors
from acsard.mcu.encoders import Encoders, Turned
from acsard.mcu.habit import Habit
from acsard.values import NS_PER_S, Instant, WheelSpeeds

BRIDGED_S = 1.0
"""s; what is missing for longer is not guessed: the MCU may have been reset."""

APART_NS = 1000
"""Between the stamps of two lines at least: what has the time of the one before is taken for it."""

LATER = 0.05
"""How quickly it follows by how much one clock is later than another."""

FULL_READ = 1024
"""Bytes that the port reads at once: behind so many there may be more."""


class Feedback(Struct, frozen=True, gc=False):
    """One good line: its sample was made at `at`, `dt` s after the previous one's.

    After a gap `dt` is 0 (how the robot moved in it is unknown) and `gap` is its length in s.
    `turned` is how far the wheels turned since the previous line by their encoders' counts, in rad
    and `WHEELS` order, where it is known; it also holds over a gap.
    """

    at: Instant
    speeds: WheelSpeeds
    dt: float
    gap: float = 0.0
    turned: Motors | None = None
    bridged: float = 0.0
    """s: the first part of `dt`, that no line reported: the speeds of its neighbours stand in."""
    asked_ns: int | None = None
    """When the line it answers was made, monotonic, where the reply tells which one that is."""
    since: float = 0.0
    """s since the previous line came, 0 after a silence: what it is judged by."""
    heard_ns: int = 0
    """When it was complete here, monotonic."""
    counted: Motors | None = None
    """rad in `WHEELS` order that the wheels turned in all of `dt` but `bridged`, where the speeds
    show whole counts (`snapping.py`)."""
    steps: Motors = (0.0, 0.0, 0.0, 0.0)
    """rad/s by which each wheel's speed steps for its encoder's sake; `math.inf` is not known."""


class Told(Struct, frozen=True, gc=False):
    """Where a line belongs by one of the clocks, ns of when it was due to be complete here."""

    clock: Literal["slots", "prompts", "reads"]
    due_ns: int
    dt: float | None = None
    """s since the last line by the same clock, None for its first."""
    bridged: float = 0.0
    """s of `dt` that no line reported."""
    place: float = 0.0
    """Its slot, of the clock found as the `found`th."""
    found: int = 0
    early: bool = False
    """It came before it was due: `due_ns` is when it came, and the next one is as far from that as
    it is due later."""


class Timeline:
    """Puts one good line after the other; remembers the last one's time and counts.

    `read` for each read, then for each of its lines `place` or, if it is none, `spoilt`.
    """

    def __init__(
        self, mcu: McuConfig, codec: Codec, wheel_speed: float, quiet_ns: int, rate_hz: float
    ) -> None:
        """`wheel_speed` rad/s is the fastest a wheel can turn; `quiet_ns` makes a link stale."""
        self._codec, self._baud_rate, self._quiet_ns = codec, mcu.baud_rate, quiet_ns
        self._encoders = Encoders(mcu.encoder_counts, wheel_speed, quiet_ns)
        self._counts = mcu.encoder_counts
        known = (mcu.reply_period,) if mcu.reply_period else ()
        self._slots = Slots((*known, 1 / rate_hz))
        self._period_ns = NS_PER_S * (mcu.reply_period or 1 / rate_hz)
        self._prompts = Prompts(wire_ns(2 * PLAIN_BYTES, mcu.baud_rate))
        self._habit = Habit(mcu.reply_period > 0)
        self._last: Instant | None = None
        self._heard_ns = self._end_ns = 0
        self._forgotten = True
        self._told = Told("reads", 0)
        """The last good line's."""
        self._later = 0.0
        """How much later answers are due by their lines than by the slots, ns, in the mean."""
        self.leaps = 0
        """Readings whose counts no wheel can have made; the speeds stood in for them."""
        self.restarted = False
        """The last line's clock says that the MCU has started again."""

    def forget(self) -> None:
        """A new session: the next line has nothing to do with the last one."""
        self._encoders.forget()
        self._slots.forget()
        self._prompts.forget()
        self._forgotten = True

    def left(self, made_ns: int) -> None:
        """A line of ours has left that was made then."""
        self._prompts.left(made_ns)
        self._habit.left()

    def read(self, at: Instant, size: int, lines: int, following: int) -> None:
        """So many lines come of a read of `size` bytes, `following` of them behind the last."""
        before, end_ns = self._end_ns, at.mono_ns
        if following:
            end_ns -= wire_ns(following, self._baud_rate)
        end_ns = self._end_ns = max(before, end_ns)
        self._at, self._rest = at, lines
        self._share_ns = (end_ns - before) / lines
        habit, slots = self._habit, self._slots
        if habit.speaks is not False:
            slots.read(end_ns, lines, size < FULL_READ)
        habit.read(lines, (end_ns - before) / self._usual_ns)
        if habit.speaks is False:
            slots.forget()
        self._prompts.read(end_ns, lines)

    def spoilt(self) -> None:
        """The read's next line is none; where the MCU made it, it was one."""
        self._rest -= 1
        if not self._habit.speaks:
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
        """The feedback of the read's next line, of `length` bytes; `following` came behind it.

        `silent` says that the link was so before it, `asked_ns` when the line it answers was made.
        """
        self._rest -= 1
        # Bytes that followed in the same read were on the wire after this line was complete.
        came_ns = self._at.mono_ns
        if following:
            came_ns -= wire_ns(following, self._baud_rate)
        came_ns = max(came_ns, self._heard_ns)
        since, self._heard_ns = (came_ns - self._heard_ns) / NS_PER_S, came_ns
        told = self._told_by(asked_ns, came_ns)
        dt, bridged = self._since_last(told)
        first = self._last is None
        turned, wheels = self._turned(reading, came_ns), None
        # Who answers makes no line that we do not ask for: none is missing for that we were silent.
        clocked = told.clock != "reads" or self._prompts.lossy
        known = clocked or not silent or dt * NS_PER_S <= self._quiet_ns
        if turned is not None:
            dt, bridged, since, known = turned.dt, 0.0, turned.dt, not silent
            wheels = self._codec.wheels(turned.motors)
        gap = 0.0
        if self._forgotten or self.restarted or not known or dt >= BRIDGED_S:
            gap = 0.0 if first else max(since, dt)
            self._share_ns = min(self._share_ns, wire_ns(length, self._baud_rate))
            self._told = self._told_by_reads() if told.clock == "reads" else told
            dt = bridged = since = 0.0
        self._forgotten = False
        at = self._sampled(came_ns, self._told, length)
        since = 0.0 if silent else since
        return Feedback(at, speeds, dt, gap, wheels, bridged, asked_ns, since, came_ns)

    def _told_by(self, asked_ns: int | None, came_ns: int) -> Told:
        """Where the next line belongs by the best clock there is."""
        speaks, slots = self._habit.speaks, self._slots
        if asked_ns is not None or not speaks:
            answered = self._prompts.answer(asked_ns)
            prompts = self._prompts
            ours = asked_ns is not None or speaks is False or prompts.thinks
            if ours and answered is not None:
                if answered.due_ns - came_ns > self._usual_ns / 2:
                    # The usual delay is that of a first answer read late, in a stall that the
                    # line before has counted: this one is no further from it than it came.
                    return Told("prompts", came_ns, early=True)
                return Told("prompts", answered.due_ns, answered.dt, answered.bridged)
        else:
            answered = None
        if slots.period is None:
            return self._told_by_reads()
        place, slot_ns, last = slots.place(self._rest), slots.time_ns(self._rest), self._told
        due_ns = min(slot_ns, came_ns)
        if answered is not None:
            self._compare(answered.due_ns - slot_ns)
        if last.clock != "slots" or last.found != slots.found:
            return Told("slots", due_ns, place=place, found=slots.found)
        passed = place - last.place if place > last.place else 0.0
        missing = passed - 1.0 if passed > 1.0 else 0.0
        dt, bridged = passed * slots.period, missing * slots.period
        return Told("slots", due_ns, dt, bridged, place, slots.found)

    def _told_by_reads(self) -> Told:
        return Told("reads", int(self._end_ns - self._share_ns * self._rest))

    def _since_last(self, told: Told) -> tuple[float, float]:
        """How long after the last good line this one was made, how much of it no line reported, s.

        Where another clock tells than told the last one, by what both say of the host's time: so
        no change of clocks adds up.
        """
        last = self._told
        back = told.due_ns < last.due_ns
        self._told = replace(told, due_ns=last.due_ns) if back else told
        by_clock = told.dt if told.clock == last.clock else None
        if by_clock is not None and not last.early:
            return by_clock, told.bridged
        late_ns = self._late_ns(told.clock) - self._late_ns(last.clock)
        dt = max(0.0, (told.due_ns - last.due_ns - late_ns) / NS_PER_S)
        if by_clock is not None:
            return dt, told.bridged
        period = self._usual_ns / NS_PER_S
        missing = dt > 1.5 * period and self._habit.speaks is not False
        return dt, dt - period if missing else 0.0

    def _compare(self, later_ns: int) -> None:
        """By their lines, answers are due so much later than by the slots."""
        if self._told.found != self._slots.found:
            self._later = float(later_ns)
        self._later += LATER * (later_ns - self._later)

    def _late_ns(self, clock: str) -> float:
        """How much later than by the slots a line is due by this clock, in the mean."""
        if clock == "reads":
            return self._slots.late_ns
        return self._later if clock == "prompts" else 0.0

    @property
    def _usual_ns(self) -> float:
        return self._slots.usual or self._period_ns

    def _sampled(self, came_ns: int, told: Told, length: int) -> Instant:
        """When the sample of a line was made: its own bytes were on the wire after that."""
        mono_ns = min(came_ns, told.due_ns) - wire_ns(length, self._baud_rate)
        last, read = self._last, self._at
        wall_ns = read.wall_ns - read.mono_ns + mono_ns
        if last is not None and mono_ns < last.mono_ns + APART_NS:
            late_ns = last.mono_ns + APART_NS - mono_ns
            mono_ns, wall_ns = mono_ns + late_ns, max(wall_ns + late_ns, last.wall_ns + APART_NS)
        self._last = Instant(mono_ns, wall_ns)
        return self._last

    def _turned(self, reading: Reading | None, at_ns: int) -> Turned | None:
        """How far the motors turned since the line before, if its counts tell."""
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
