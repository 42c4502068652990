"""What a line says of how far the wheels rolled since the one before: each second, each count once.

By the encoders' own counts where there are such; else by whole counts that the speeds show; else by
the speeds times the time. What no line reported lies between two speeds; but a silence so long that
the wheels were told to stand went on as before it no longer than until then. What lines should have
told that cannot be true is left to the next one that can.
"""

from __future__ import annotations

import math

from msgspec import Struct

from acsard.drive.gyro import Turn
from acsard.mcu.codec import Motors
from acsard.mcu.feedback import Feedback
from acsard.mcu.lattice import on
from acsard.values import Pose, WheelSpeeds

MAX_LOST_S = 0.05
"""s of lines that could not be true, up to which the robot is held to have gone on as it did."""

NOWHERE = (0.0, 0.0, 0.0, 0.0)


class Rolled(Struct, frozen=True, gc=False):
    """Wheel angles since the last line that was believed, rad in `WHEELS` order."""

    pieces: tuple[Motors, ...]
    """In the order in which they came about, an arc each; without those that are nothing."""
    turned: Motors
    """By the encoders' counts, which are cumulative: before the `pieces`."""
    seen: Motors
    """What this line alone says, as it rolls: no rounding made good, no lines before it."""
    seconds: float
    """in which `seen` came about,"""
    bridged: float
    """of it, that no line reported,"""
    unknown: float
    """besides, in which nobody knows what the robot did,"""
    known: float
    """and in which all of `pieces` and `turned` came about; 0 where some of the way is unknown."""


class Rolling:
    """Remembers the lines that were passed over; `take` the next one that can be true."""

    def __init__(self, quiet: float = math.inf) -> None:
        """`quiet` s of silence make the link stale, and wheels are told to stand then."""
        self._quiet = quiet
        self._lost = self._gap = self._counted = 0.0
        """s of the lines passed over: without counts, unreported before them, with counts."""
        self._turned = NOWHERE

    def skip(self, line: Feedback) -> None:
        """Pass over a line: of counts nothing is lost, else only its time is known."""
        if line.turned is None:
            self._lost += line.dt
            self._gap += line.gap
        else:
            self._counted += line.dt
            self._turned = plus(self._turned, line.turned)

    def take(self, line: Feedback, before: WheelSpeeds) -> Rolled:
        """What the next line says; the last one that was believed said `before`."""
        speeds, dt, bridged = line.speeds.as_tuple(), line.dt, line.bridged
        passed_over = self._lost or self._gap or self._counted or self._turned != NOWHERE
        if not (passed_over or bridged or line.gap or line.turned is not None):
            # Nearly every line without counts of its own: the rest of this, of that line alone.
            seen = times(speeds, dt)
            pieces = _some(seen if line.counted is None else line.counted)
            return Rolled(pieces, NOWHERE, seen, dt, 0.0, 0.0, dt)
        # Of lost lines without counts: it went on at about this speed, or too long to guess.
        lost, unknown = (self._lost, 0.0) if self._lost <= MAX_LOST_S else (0.0, self._lost)
        turned, unknown, known = self._turned, unknown + self._gap, lost + self._counted + dt
        if passed_over:
            self._lost = self._gap = self._counted = 0.0
            self._turned = NOWHERE
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
    """Wheel by wheel."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]


def times(a: Motors, factor: float) -> Motors:
    """Wheel by wheel."""
    return a[0] * factor, a[1] * factor, a[2] * factor, a[3] * factor


class Step(Struct, frozen=True, gc=False):
    """A line's part of the way."""

    pose: Pose
    """Where it was before."""
    pieces: tuple[Motors, ...]
    """How its wheels turned from there, rad,"""
    gyro: Turn | None
    """by a gyro too,"""
    speeds: WheelSpeeds
    """and the speeds they said."""
    turn: float
    """rad that the heading turned,"""
    on_trial: bool
    """which a gyro on trial will put right once it is proved."""
    share: float = 1.0
    """The track that its wheels turned it by, of the configured one."""


def count_of(line: Feedback) -> float:
    """rad of the coarsest encoder's count, of a line that shows whole ones; 0 if none does."""
    rows = zip(line.counted or NOWHERE, line.speeds.as_tuple(), line.steps, strict=True)
    return max([
        step * turned / speed for turned, speed, step in rows
        if speed and 0.0 < step < math.inf and on(speed, step)
    ], default=0.0)  # fmt: skip
