"""Fills gaps: how far the wheels rolled since the last believed line, and how uncertain that is.

Each second and each count is used exactly once. The angles come from the encoders' own counts, else
from whole counts that the speeds show, else from speed times time. A time that no line reported is
filled half with the speed before it and half with the speed after it. But if the silence was so
long that the daemon commanded rest, the earlier speed counts only until then. The motion of
impossible lines is left to the next possible one.

`Rolling` computes the angles. `Gaps` estimates how far the motion in a gap deviates from a straight
line between the two known speeds.
"""

from __future__ import annotations

import math

from msgspec import Struct

from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.values import REST, Twist, WheelSpeeds

MAX_LOST_S, MAX_LOST = 0.05, 1
"""Impossible lines over which the robot is assumed to have kept its motion: this many seconds of
them, or this many lines at any distance."""

NOWHERE = (0.0, 0.0, 0.0, 0.0)

GUESS = Twist(0.125, 0.5)
"""Assumed s_a over `SPAN` before any measurement, m/s2 and rad/s2: an eighth of the default limits,
which random driving at these limits hardly reaches."""

SPAN = 0.2
"""Time over which the deviation is measured, s."""

FIRST, MOST = 4.0, 300.0
"""Number of spans for which the assumption counts, and number that is remembered: a minute of
driving."""

GROWTH = 5
"""Power of the time with which the variance grows: 4 from s_a2 t4 / 4, and 1 from the growth of
s_a2."""


class Rolled(Struct, frozen=True, gc=False):
    """Wheel angles since the last line that was believed, rad in `WHEELS` order."""

    pieces: tuple[Motors, ...]
    """The angles in the order in which they occurred, one arc each, without empty ones."""
    turned: Motors
    """The angles by the encoders' cumulative counts. They precede the `pieces`."""
    seen: Motors
    """The angles in `seconds` by this line's own speeds or counts, without corrections for
    rounding."""
    seconds: float
    """Duration of `seen`, s."""
    bridged: float
    """Part of `seconds` that no line reported, s."""
    unknown: float
    """Further time in which the motion of the robot is unknown, s."""
    known: float
    """Duration of `pieces` and `turned` together, s; 0 if a part of the motion is unknown."""


class Rolling:
    """The lines that were passed over, until `take` of the next possible one."""

    def __init__(self, quiet: float = math.inf) -> None:
        """Start; after `quiet` s of silence the link is stale and the daemon commands rest."""
        self._quiet = quiet
        self._lost = self._gap = self._counted = 0.0
        """Seconds of the lines passed over: those without counts, the gaps before them, those with
        counts."""
        self._turned, self._skipped = NOWHERE, 0

    def skip(self, line: Feedback) -> None:
        """Pass over a line. Its counts are kept, and of a line without counts only the time."""
        self._skipped += 1
        if line.turned is None:
            self._lost += line.dt
            self._gap += line.gap
        else:
            self._counted += line.dt
            self._turned = plus(self._turned, line.turned)

    def take(self, line: Feedback, before: WheelSpeeds) -> Rolled:
        """Return the angles by the next line; the last believed line had the speeds `before`."""
        speeds, dt, bridged = line.speeds.as_tuple(), line.dt, line.bridged
        if not (self._skipped or bridged or line.gap or line.turned is not None):
            # The short way for nearly every line: the general way below gives the same for this
            # line alone.
            seen = times(speeds, dt)
            pieces = _some(seen if line.counted is None else line.counted)
            return Rolled(pieces, NOWHERE, seen, dt, 0.0, 0.0, dt)
        # Lost lines without counts are filled in at about this speed, unless they last too long to
        # guess.
        guessed = self._lost <= MAX_LOST_S or self._skipped <= MAX_LOST
        lost, unknown = (self._lost, 0.0) if guessed else (0.0, self._lost)
        turned, unknown, known = self._turned, unknown + self._gap, lost + self._counted + dt
        if self._skipped:
            self._lost = self._gap = self._counted = 0.0
            self._turned, self._skipped = NOWHERE, 0
        if line.turned is not None:
            pieces, seen, seconds = _some(times(speeds, lost)), line.turned, dt
            turned, bridged = plus(turned, line.turned), 0.0
        else:
            unknown, seconds = unknown + line.gap, lost + dt
            seen = said = times(speeds, seconds - bridged)
            pieces = _some(said)
            if line.counted is not None:
                pieces = _some(line.counted, times(speeds, lost))
            if bridged:
                on = min(bridged / 2, self._quiet)
                between = plus(times(before.as_tuple(), on), times(speeds, bridged - on))
                seen, pieces = plus(between, said), _some(between, *pieces)
        return Rolled(pieces, turned, seen, seconds, bridged, unknown, 0.0 if unknown else known)


def _some(*pieces: Motors) -> tuple[Motors, ...]:
    return tuple([piece for piece in pieces if piece != NOWHERE])


def plus(a: Motors, b: Motors) -> Motors:
    """Return the sum of two sets of wheel angles."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]


def times(a: Motors, factor: float) -> Motors:
    """Return wheel angles or speeds times a factor."""
    return a[0] * factor, a[1] * factor, a[2] * factor, a[3] * factor


class Gaps:
    """The measured s_a, and the variances of the way in gaps.

    After t s without lines the deviation is s_a t2 / 2, along and turning, where s_a is the
    standard deviation of the acceleration. The limits bound s_a, but few drives stay at them.
    Therefore s_a is measured while lines come: it compares the way in every fifth of a second with
    the way that the first and the last speed would have made. The robot may change its acceleration
    at any time, so s_a2 itself grows with t. The deviation never exceeds the way at the faster
    speed: a robot that stood before and after the gap has not moved.
    """

    def __init__(self) -> None:
        self._along = (GUESS.linear * SPAN**2 / 2) ** 2
        self._turning = (GUESS.angular * SPAN**2 / 2) ** 2
        self._spans = FIRST
        self.interrupt(REST)

    def interrupt(self, twist: Twist) -> None:
        """Start a new span with `twist`, independent of the span before."""
        self._first, self._seconds, self._distance, self._turn = twist, 0.0, 0.0, 0.0
        self._bridged, self._given = 0.0, (0.0, 0.0)

    def follow(self, twist: Twist, dt: float) -> None:
        """Take a line that reports `twist` for the last `dt` s."""
        linear, angular = twist.linear, twist.angular
        self._bridged, self._given = 0.0, (0.0, 0.0)
        self._seconds += dt
        self._distance += linear * dt
        self._turn += angular * dt
        span = self._seconds - dt  # the time between the two lines whose speeds are taken as known
        if span < SPAN:
            return
        first = self._first
        if self._distance or self._turn or linear or angular:
            off = self._distance - linear * dt - span * (first.linear + linear) / 2
            turned = self._turn - angular * dt - span * (first.angular + angular) / 2
            scale = (SPAN / span) ** GROWTH
            self._spans = min(self._spans + 1.0, MOST)
            self._along += (off * off * scale - self._along) / self._spans
            self._turning += (turned * turned * scale - self._turning) / self._spans
        self._first, self._seconds, self._distance, self._turn = twist, 0.0, 0.0, 0.0

    def bridge(self, seconds: float, before: Twist, after: Twist) -> tuple[float, float]:
        """Return the variances, m2 along and rad2, that `seconds` more of a filled gap add.

        A gap may come in several consecutive pieces. They count as one gap.
        """
        bridged, given = self._bridged + seconds, self._given
        along, yaw = self.unseen(bridged, before, after)
        self.interrupt(after)
        self._bridged, self._given = bridged, (max(along, given[0]), max(yaw, given[1]))
        return max(0.0, along - given[0]), max(0.0, yaw - given[1])

    def unseen(self, seconds: float, before: Twist, after: Twist) -> tuple[float, float]:
        """Return the variances of `seconds` between two known twists, m2 along and rad2."""
        scale = (seconds / SPAN) ** GROWTH
        fastest = max(abs(before.linear), abs(after.linear)) * seconds
        turning = max(abs(before.angular), abs(after.angular)) * seconds
        return min(self._along * scale, fastest**2), min(self._turning * scale, turning**2)
