"""Computes how far the wheels rolled since the last believed line.

Each second and each count is used exactly once. The angles come from the encoders' own counts, else
from whole counts that the speeds show, else from speed times time. A time that no line reported is
filled half with the speed before it and half with the speed after it. But if the silence was so
long that the daemon commanded rest, the earlier speed counts only until then. The motion of
impossible lines is left to the next possible one.
"""

from __future__ import annotations

import math

from msgspec import Struct

from acsard.core.link.codec import Motors
from acsard.core.link.feedback import Feedback
from acsard.core.link.quantization_step import on
from acsard.core.motion.gyro import Turn
from acsard.core.values import Pose, WheelSpeeds

MAX_LOST_S, MAX_LOST = 0.05, 1
"""Impossible lines over which the robot is assumed to have kept its motion: this many seconds of
them, or this many lines at any distance."""

NOWHERE = (0.0, 0.0, 0.0, 0.0)


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


class Step(Struct, frozen=True, gc=False):
    """The part of the way that one line added."""

    pose: Pose
    """The pose before the line."""
    pieces: tuple[Motors, ...]
    """How far the wheels turned in it, rad."""
    gyro: Turn | None
    """The turn by a gyro, None without one."""
    speeds: WheelSpeeds
    """The speeds in the line."""
    turn: float
    """Change of the heading, rad."""
    on_trial: bool
    """Whether a gyro on trial will correct the turn when the gyro is proven."""
    share: float = 1.0
    """The track by which the wheels turned the robot, as a share of the configured one."""


def count_of(line: Feedback) -> float:
    """Return the angle of the coarsest encoder's count that a line shows, rad, 0 if unknown."""
    rows = zip(line.counted or NOWHERE, line.speeds.as_tuple(), line.steps, strict=True)
    return max([
        step * turned / speed for turned, speed, step in rows
        if speed and 0.0 < step < math.inf and on(speed, step)
    ], default=0.0)  # fmt: skip
