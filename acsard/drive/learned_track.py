"""Which effective track the wheels turn the robot by: the configured one, or what a gyro taught.

While a gyro tells the heading, each turn teaches how far the robot turns per turn of its wheels
(`gyro_match.py`). Where the wheels are alone again, that is worth more than a track nobody measured
on this floor. It is used where `[odometry] learned_track` asks for it, once it is known, and within
bounds. Only turns to come are others by it: the pose does not jump.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.values import Event, GyroStatus, Level, TrackUse

LEAST = 0.05
"""Standard deviation at best, as a share: the next floor is another one, and so is the next rate.
That is half of `gyro_match.FINE`, how far a single moment of it may be off: a way has many."""

CERTAIN, UNCERTAIN = 0.1, 0.2
"""Standard deviations, as shares: it is known from the first on, and no more beyond the second."""

BOUNDS = (0.5, 2.5)
"""Shares of the configured track. Robots skid by 1.4 to 1.9 on most floors, by 2.5 on slippery ones
(drive.wheel_separation alone); beyond, either of the two is wrong."""

INWARDS = 1.05
"""By which factor within the bounds it has to come before it is used: at a bound each turn would
else be by another track."""

NOTES: dict[TrackUse, str] = {
    "shown": "(only shown)",
    "uncertain": "(uncertain)",
    "too far off": "(too far off)",
    "used": "in use",
}


class Track(Struct, frozen=True):
    """An effective track as a share of the configured one."""

    share: float = 1.0
    deviation: float = 0.0
    """Its standard deviation as a share of itself; 0 for the configured one, whose own `[odometry]`
    declares."""


CONFIGURED = Track()


class LearnedTrack:
    """Decides which of them is used, and remembers it."""

    def __init__(self, multiplier: float) -> None:
        """`multiplier` is the configured track over the wheel separation."""
        self._multiplier = multiplier
        self.use: TrackUse = "uncertain"
        """What becomes of the learned one."""
        self.used = CONFIGURED
        """The one to turn by."""
        self.event: Event | None = None
        """What the last look changed."""

    def look(self, learned: Track | None) -> None:
        """What has been learned by now; None is nothing yet."""
        before, self.event = self.use, None
        self.use = _use(learned, before)
        self.used = learned if learned is not None and self.use == "used" else CONFIGURED
        if learned is not None and self.use != before:
            told = f"the wheels' effective track: {beside(learned, self._multiplier, self.use)}"
            level: Level = "warning" if self.use == "too far off" else "info"
            self.event = Event("track", told, level, kind=self.use)


def _use(learned: Track | None, before: TrackUse) -> TrackUse:
    most = CERTAIN if before == "uncertain" else UNCERTAIN
    if learned is None or learned.deviation > most:
        return "uncertain"
    inwards = 1.0 if before == "used" else INWARDS
    within = BOUNDS[0] * inwards <= learned.share <= BOUNDS[1] / inwards
    return "used" if within else "too far off"


def beside(learned: Track, multiplier: float, use: TrackUse) -> str:
    """Both multipliers in words, and which of them is in use."""
    value = learned.share * multiplier
    configured = "" if use == "used" else " in use"
    return (
        f"learned {value:.3f} ± {value * learned.deviation:.3f} {NOTES[use]}, "
        f"configured {multiplier:.3f}{configured}"
    )


def tracks(gyro: GyroStatus, multiplier: float) -> str:
    """Of what a gyro has taught; "" where that is nothing yet."""
    if gyro.track is None:
        return ""
    return beside(Track(gyro.track, gyro.track_deviation), multiplier, gyro.track_use)
