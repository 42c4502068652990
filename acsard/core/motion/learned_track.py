"""Chooses the effective track by which the wheels turn the robot: configured, or learned by a gyro.

While a gyro tells the heading, each turn shows how far the robot turns per turn of its wheels
(`gyro_match.py`). When the wheels are alone again, this track is better than one that nobody
measured on this floor. It is used if `[odometry] learned_track` asks for it, once it is known and
if it lies within bounds. It affects only later turns, so the pose does not jump.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.core.values import Event, GyroStatus, Level, TrackUse

LEAST = 0.05
"""Least relative standard deviation, because the next floor and the next rate differ. It is half of
`gyro_match.FINE`, the error of a single moment, because a way has many moments."""

CERTAIN, UNCERTAIN = 0.1, 0.2
"""Relative standard deviations: the track is known below the first one, and no longer known above
the second."""

BOUNDS = (0.5, 2.5)
"""Range of the learned track as a share of the configured one. Robots skid by 1.4 to 1.9 on most
floors, by 2.5 on slippery ones (with drive.wheel_separation alone). Beyond the range one of the two
tracks is wrong."""

INWARDS = 1.05
"""Factor by which the track must lie inside the range before it is used. Without it the track would
change with each turn at a bound."""

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
    """Standard deviation as a share of the track. It is 0 for the configured track, whose deviation
    `[odometry]` declares."""


CONFIGURED = Track()


class LearnedTrack:
    """The decision between the configured and the learned track."""

    def __init__(self, multiplier: float) -> None:
        """Start; `multiplier` is the configured track over the wheel separation."""
        self._multiplier = multiplier
        self.use: TrackUse = "uncertain"
        """The present use of the learned track."""
        self.used = CONFIGURED
        """The track by which the wheels turn the robot."""
        self.event: Event | None = None
        """The event of the last `look`, if it changed the use."""

    def look(self, learned: Track | None) -> None:
        """Take the track learned so far, None before the first one."""
        before, self.event = self.use, None
        self.use = _use(learned, before)
        self.used = learned if learned is not None and self.use == "used" else CONFIGURED
        if learned is not None and self.use != before:
            told = f"the wheels' effective track: {beside(learned, self._multiplier, self.use)}"
            level: Level = "warning" if self.use == "too far off" else "info"
            self.event = Event("learned_track", told, level, kind=self.use)


def _use(learned: Track | None, before: TrackUse) -> TrackUse:
    most = CERTAIN if before == "uncertain" else UNCERTAIN
    if learned is None or learned.deviation > most:
        return "uncertain"
    inwards = 1.0 if before == "used" else INWARDS
    within = BOUNDS[0] * inwards <= learned.share <= BOUNDS[1] / inwards
    return "used" if within else "too far off"


def beside(learned: Track, multiplier: float, use: TrackUse) -> str:
    """Return both multipliers in words, and which one is in use."""
    value = learned.share * multiplier
    configured = "" if use == "used" else " in use"
    return (
        f"learned {value:.3f} ± {value * learned.deviation:.3f} {NOTES[use]}, "
        f"configured {multiplier:.3f}{configured}"
    )


def tracks(gyro: GyroStatus, multiplier: float) -> str:
    """Return the tracks in words, "" if the gyro has taught none yet."""
    if gyro.track is None:
        return ""
    return beside(Track(gyro.track, gyro.track_deviation), multiplier, gyro.track_use)
