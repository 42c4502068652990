"""Checks whether feedback is physically possible.

A line in which a wheel turns, or changes its speed, faster than any wheel can is not used, and
several in a row are a fault. More than one in a hundred is a warning: damage on the wire, or a
limit in `[feedback]` that is too low. One count in a short time looks like a high speed, so the
angles decide: what a wheel turns beyond the limit, over all lines, may be one count, or two by the
speeds alone. A change may be larger by two counts. It counts from the last possible line. Until two
lines have agreed within a short time, it is possible if the line agrees with the one before it: the
first line may be damaged, and then the true ones look impossible.
"""

from __future__ import annotations

import math
from operator import sub

from msgspec import Struct

from acsard.core.link.coarse_encoders import COARSEST_COUNT, JUMP_ANGLE, JUMP_SPEED, MIN_COUNT_S
from acsard.core.link.feedback import Line
from acsard.core.values import Event, RadPerS, Seconds, Wheels4

FAULT_LINES = 3  # in a row: 30 ms at 100 Hz

WINDOW_LINES = 1000  # 10 s at 100 Hz

WARNING_FRACTION = 0.01  # of a window, above which one warning is logged

SPEED_MARGIN = 2.0  # rad/s beyond `MAX_WHEEL_ACCELERATION`, by coarse encoders

MAX_WHEEL_ACCELERATION = 1500.0  # rad/s2, more than any real wheel's

# Each of two speeds may be wrong by one, and a board that measures by its own clock may report the
# count of one measurement twice. The counts themselves are at most one more.
COUNT_MARGIN = 2

INSTANT_S = 0.02  # that a line without counts speaks for: it may report its last instant

CLOCK_S = 0.001  # rounding of the board's clock

NOT_FAST: Wheels4 = (0.0, 0.0, 0.0, 0.0)


class Measured(Struct, frozen=True, gc=False):
    """The speeds of a line, which are means: the middle of its time stands for them."""

    speeds: Wheels4
    middle: Seconds


class Sanity(Struct):
    """Checks whether the wheel speeds in each feedback line are physically possible."""

    time: Seconds = 0.0  # of all lines
    possible: Measured | None = None  # the last possible line
    before: Measured | None = None  # the last line
    trusted: bool = False  # two lines have agreed
    count: int = 0  # of the last impossible lines
    dropped_s: Seconds = 0.0  # their time
    # By how much each wheel turned further than at the limit, rad: the sum over possible lines,
    # which slower ones reduce. A wheel at rest may rock between the edges of a count.
    beyond: Wheels4 = NOT_FAST
    lines: int = 0  # of the window
    dropped: int = 0  # impossible ones of the window
    warning: Event | None = None  # only if the last line caused it

    def forget(self) -> None:
        """Start over after a lost link or a cleared fault."""
        self.trusted, self.count, self.beyond = False, 0, NOT_FAST

    @property
    def failed(self) -> bool:
        """Whether the last `FAULT_LINES` lines were impossible, which latches a fault."""
        return self.count >= FAULT_LINES

    def impossible(self, line: Line, fastest: RadPerS, names: tuple[str, ...]) -> str:
        """Return why no wheel can have these speeds, or "".

        `fastest` is `feedback.wheel_speed`, and `names` are those of the driven wheels. Updates
        `failed` and `warning`.
        """
        dt, since = line.dt, line.since
        since = since if since > dt else dt
        self.time += since
        if line.gap:
            self.possible, self.before, self.trusted = None, None, False
            self.beyond, self.dropped_s = NOT_FAST, 0.0
        speeds = line.speeds.as_tuple()
        now = Measured(speeds, self.time - dt / 2)
        why, beyond = "", self.beyond
        if beyond is not NOT_FAST or max(map(abs, speeds)) > fastest:
            why = self._too_fast(line, speeds, fastest, names)
        possible, before, step = self.possible, self.before, line.step
        if line.counted is not None:
            step = line.count / MIN_COUNT_S  # the board has an own time for its counts
        # A line of a burst may have no time of its own: it moves nothing, and its step is unknown.
        timed = line.turned is None and dt > 0.0
        if not why and possible is not None and before is not None and timed:
            sudden = max(map(abs, map(sub, speeds, possible.speeds))) > SPEED_MARGIN
            if sudden and (self.trusted or _jump(now, before, step, names)):
                why = _jump(now, possible, step, names)
        self.before, self.warning = now, None
        self.lines += 1
        if why:
            self.beyond = beyond
            self.dropped += 1
            self.count += 1
            self.dropped_s += since
            if self.dropped == int(WARNING_FRACTION * WINDOW_LINES) + 1:
                self.warning = Event("lines_implausible", self._warning_text(why), "warning")
        else:
            # A comparison that no speed fails proves nothing.
            passed = math.inf if possible is None else now.middle - possible.middle
            self.trusted = MAX_WHEEL_ACCELERATION * passed < fastest
            self.possible, self.count, self.dropped_s = now, 0, 0.0
        if self.lines == WINDOW_LINES:
            self.lines = self.dropped = 0
        return why

    def _warning_text(self, why: str) -> str:
        setting = why.rpartition(" over ")[2]
        return (
            f"{self.dropped} of {self.lines} lines were dropped, because no wheel can do "
            f"what they report; the last: {why}. If a wheel really does that, raise {setting}. "
            "Otherwise lines arrive damaged: check cable and ground; firmware that "
            'supports mcu.link_check = "on" protects each line with a checksum'
        )

    def _too_fast(
        self, line: Line, speeds: Wheels4, fastest: RadPerS, names: tuple[str, ...]
    ) -> str:
        own = line.dt - line.bridged
        usual = max(MIN_COUNT_S, min(own, INSTANT_S))
        unknown = line.step == math.inf
        one = line.count or (COARSEST_COUNT if line.step else JUMP_ANGLE)
        most = one if line.by_counts else COUNT_MARGIN * one
        if line.turned is not None:
            most += fastest * CLOCK_S
        # While the encoders are unknown, a line has one count of the coarsest encoder at most, or
        # one of a fine encoder that the board has counted for less time. A line without a known
        # time moves nothing, so no count in it is excused.
        highest = max(fastest + JUMP_SPEED, COARSEST_COUNT / usual) if own > 0.0 else fastest
        beyond = []
        for wheel, speed in enumerate(speeds):
            if line.turned is not None:
                angle, seconds = line.turned[wheel], line.dt
            elif line.counted is not None and speed:
                angle = line.counted[wheel]
                seconds = abs(angle / speed)  # in which the board has counted
            else:
                angle, seconds = speed * usual, usual
            # The pose fills the time of the impossible lines before this one with its speeds.
            angle += self.beyond[wheel] + speed * self.dropped_s
            over = max(0.0, abs(angle) - fastest * (seconds + self.dropped_s))
            beyond.append(math.copysign(over, angle))
            size = abs(speed)
            if size > fastest and (over > most or (unknown and size > highest)):
                return f"{names[wheel]} at {speed:.2f} rad/s is over feedback.wheel_speed"
        a, b, c, d = beyond
        self.beyond = (a, b, c, d) if any(beyond) else NOT_FAST
        return ""


def _jump(now: Measured, then: Measured, step: RadPerS, names: tuple[str, ...]) -> str:
    seconds = max(now.middle - then.middle, MIN_COUNT_S)
    most = MAX_WHEEL_ACCELERATION * seconds + SPEED_MARGIN + COUNT_MARGIN * step
    for name, speed, before in zip(names, now.speeds, then.speeds, strict=False):
        if abs(speed - before) > most:
            leap = f"{name} jumps from {before:.2f} to {speed:.2f} rad/s"
            return f"{leap}, which is over {MAX_WHEEL_ACCELERATION:g} rad/s2"
    return ""
