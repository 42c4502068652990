"""Checks whether feedback is physically possible.

A line in which a wheel turns, or changes its speed, faster than any wheel can is not used, and
several in a row are a fault. More than one in a hundred is a warning: damage on the wire, or a
limit in `[feedback]` that is too low. A damaged plain line may look possible, and then the true
ones look impossible. So a possible line is trusted only if it agrees with the one before it, and
two later lines that agree outvote it. One count in a short time looks like a high speed, so a
change may be larger by two counts, and speeds over the limit may add up to one count.
"""

from __future__ import annotations

import math
from operator import sub

from msgspec import Struct

from acsard.core.link.coarse_encoders import COARSEST_COUNT, JUMP_ANGLE, JUMP_SPEED, MIN_COUNT_S
from acsard.core.link.feedback import Line
from acsard.core.values import Event, RadPerS, Wheels4, WheelSpeeds

FAULT_LINES = 3  # in a row: 30 ms at 100 Hz

WINDOW_LINES = 1000  # 10 s at 100 Hz

WARNING_FRACTION = 0.01  # of a window, above which one warning is logged

SPEED_MARGIN = 2.0  # rad/s beyond `MAX_WHEEL_ACCELERATION`, by coarse encoders

MAX_WHEEL_ACCELERATION = 1500.0  # rad/s2, more than any real wheel's

COUNT_MARGIN = 2  # each of two reports may be wrong by one

# Least time between two lines: while this computer catches up, one count would look fast.
MIN_INTERVAL_S = 0.004

NOT_FAST: Wheels4 = (0.0, 0.0, 0.0, 0.0)


class Sanity(Struct):
    """Checks whether the wheel speeds in each feedback line are physically possible.

    Changes count from the last possible line. If that one is not trusted, a line that contradicts
    it is possible if it agrees with one of the impossible lines in between.
    """

    last: WheelSpeeds | None = None  # possible speeds
    trusted: bool = False  # the wheels can change back to the line before by the next one
    # Newest impossible lines since `last`, with the time since it, s; not too fast ones.
    rejected: list[tuple[WheelSpeeds, float]] = []
    since: float = 0.0  # s since `last`
    longest: float = 0.0  # s that a recent line covers (recent for as long)
    count: int = 0  # of the last impossible lines
    # By how much each wheel turned further than at the limit, rad: the sum over possible lines,
    # which slower ones reduce. It is one count at most.
    beyond: Wheels4 = NOT_FAST
    lines: int = 0  # of the window
    dropped: int = 0  # impossible ones of the window
    warning: Event | None = None  # only if the last line caused it

    def forget(self) -> None:
        """Start over after a lost link or a cleared fault; the last line is not trusted."""
        self.trusted, self.count, self.beyond = False, 0, NOT_FAST

    @property
    def failed(self) -> bool:
        """Whether the last `FAULT_LINES` lines were impossible, which latches a fault."""
        return self.count >= FAULT_LINES

    def impossible(self, line: Line, fastest: RadPerS, names: tuple[str, ...]) -> str:
        """Return why no wheel can have these speeds, or "".

        `fastest` is `feedback.wheel_speed`, and `names` are those of the driven wheels.
        The allowed change grows with the time since the last possible line, so a real jump is
        accepted in time. Updates `failed` and `warning`.
        """
        dt, since = line.dt, line.since
        since = dt if dt > since else since
        self.since += since
        longest = self.longest - since if self.longest > since else 0.0
        self.longest = longest if longest > since else since
        if line.gap:
            self.last, self.beyond = None, NOT_FAST
            self.rejected.clear()
        speeds, last = line.speeds, self.last
        wheels = speeds.as_tuple()
        change = 0.0 if last is None else max(map(abs, map(sub, wheels, last.as_tuple())))
        why = ""
        # Every wheel can change by `SPEED_MARGIN` at once.
        sudden = change > SPEED_MARGIN
        beyond = self.beyond  # an impossible line does not change it
        over = beyond is not NOT_FAST or max(map(abs, wheels)) > fastest
        if over or (sudden and change > self._most(self.since, longest)):
            most = self._most(self.since, longest)
            why = self._too_fast(line, fastest, names)
            if not why and last is not None:
                why = self._jump(line, last, most, names)
                if why:
                    agrees = not self.trusted and self._agrees(line, longest, names)
                    self.rejected = [*self.rejected[1 - FAULT_LINES :], (speeds, self.since)]
                    why = "" if agrees else why
        self.lines += 1
        self.warning = None
        if why:
            self.beyond = beyond
            self.dropped += 1
            self.count += 1
            if self.dropped == int(WARNING_FRACTION * WINDOW_LINES) + 1:
                self.warning = Event("lines_implausible", self._warning_text(why), "warning")
        if self.lines == WINDOW_LINES:
            self.lines = self.dropped = 0
        if why:
            return why
        # If this line is damaged, the speeds change back by `change` in the next line. Every next
        # line may at least change by as much as a wheel can in half of `_longest`.
        small = not sudden or change <= self._most(0.0, self.longest)
        self.trusted = last is not None and small
        self.last, self.since, self.count = speeds, 0.0, 0
        if self.rejected:
            self.rejected.clear()
        return ""

    def _most(self, since: float, longest: float) -> float:
        # Speeds are means: the change may have lasted from the middle of one to that of the next.
        mean = (since + longest) / 2
        return MAX_WHEEL_ACCELERATION * (mean if mean > since else since) + SPEED_MARGIN

    def _agrees(self, line: Line, longest: float, names: tuple[str, ...]) -> bool:
        return any(
            not self._jump(line, speeds, self._most(self.since - since, longest), names)
            for speeds, since in self.rejected
        )

    def _warning_text(self, why: str) -> str:
        setting = why.rpartition(" over ")[2]
        return (
            f"{self.dropped} of {self.lines} lines were dropped, because no wheel can do "
            f"what they report; the last: {why}. If a wheel really does that, raise {setting}. "
            "Otherwise lines arrive damaged: check cable and ground; firmware that "
            'supports mcu.link_check = "on" protects each line with a checksum'
        )

    def _too_fast(self, line: Line, fastest: RadPerS, names: tuple[str, ...]) -> str:
        turned, own = line.by_counts, line.dt - line.bridged
        usual = max(own, MIN_COUNT_S)
        known = line.step < math.inf
        # The pose fills the time of the impossible lines before this one with its speeds.
        dropped_s = max(0.0, self.since - max(line.dt, line.since))
        # While the encoders are unknown, a line has one count of the coarsest encoder at most, or
        # one of a fine encoder that the board has counted for less time. A line without a known
        # time moves nothing, so no count in it is excused.
        most = max(fastest + JUMP_SPEED, COARSEST_COUNT / usual) if own > 0.0 else fastest
        beyond, speeds = list(self.beyond), line.speeds.as_tuple()
        # Fine encoders have no step, but without declared counts one of them may be over the limit.
        undeclared = 0.0 if line.count else JUMP_ANGLE
        one = min(max(line.step * usual, undeclared), COARSEST_COUNT)
        for wheel, now in enumerate(speeds):
            size, time, count = abs(now), usual, one
            if turned is not None:
                count = line.count
                if now and turned[wheel]:
                    time = abs(turned[wheel]) / size  # in which the board has counted
            over = beyond[wheel] = max(0.0, beyond[wheel] + (size - fastest) * (time + dropped_s))
            if size > fastest and (over > count or not (known or size <= most)):
                return f"{names[wheel]} at {now:.2f} rad/s is over feedback.wheel_speed"
        a, b, c, d = beyond
        self.beyond = (a, b, c, d) if any(beyond) else NOT_FAST
        return ""

    def _jump(self, line: Line, before: WheelSpeeds, most: float, names: tuple[str, ...]) -> str:
        least = line.count / MIN_INTERVAL_S if line.by_counts is not None else 0.0
        most += COUNT_MARGIN * max(line.step, least)
        rows = zip(names, line.speeds.as_tuple(), before.as_tuple(), strict=False)
        for name, now, then in rows:
            if abs(now - then) > most:
                leap = f"{name} jumps from {then:.2f} to {now:.2f} rad/s"
                return f"{leap}, which is over {MAX_WHEEL_ACCELERATION:g} rad/s2"
        return ""
