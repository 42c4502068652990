"""Chooses the effective track for turns that only the wheels measure: configured or learned.

The effective track is the distance between left and right wheels that makes computed turns right.
While a gyro measures the heading, each turn shows the true effective track (`gyro_match.py`). When
the gyro is silent, this learned track is better than the configured one, which may come from
another floor. The learned track is used if `[odometry] learned_track` is true, and if the learned
value is certain enough and plausible. It affects only later turns, so the pose does not jump.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.core.values import Event, GyroStatus, Level, TrackUse

MIN_TRACK_STD = 0.05
"""Smallest relative standard deviation of a learned track. The real track changes with the floor
and the turn rate, so no measurement makes it more certain than this. The value is half of
`gyro_match.MIN_RATIO_STD`, because the mean error over a whole drive is smaller than the error at
one moment."""

CERTAIN, UNCERTAIN = 0.1, 0.2
"""Limits of the learned track's relative standard deviation. An uncertain track becomes certain
below `CERTAIN`, and a certain track becomes uncertain above `UNCERTAIN`."""

TRACK_RATIO_RANGE = (0.5, 2.5)
"""Range of the ratio of the learned track to the configured track. Outside this range, the learned
track is not used. The effective track is 1.4 to 1.9 times the wheel separation on most floors, and
2.5 times on slippery ones."""

RANGE_HYSTERESIS = 1.05
"""Factor that narrows `TRACK_RATIO_RANGE` for a learned track that is not in use. The lower bound
is multiplied by this factor, and the upper bound is divided by it. Without this margin, a track
near a bound could alternate between use and non-use."""

STATUS_TEXTS: dict[TrackUse, str] = {
    "shown": "(only reported)",
    "uncertain": "(uncertain)",
    "too far off": "(out of range, not used)",
    "used": "(in use)",
}


class Track(Struct, frozen=True):
    """An effective track, relative to the configured one."""

    share: float = 1.0
    """The effective track divided by the configured one."""
    deviation: float = 0.0
    """Relative standard deviation; 0 for the configured track, whose deviation is a setting."""


CONFIGURED = Track()


class LearnedTrack:
    """Decides whether the odometry uses the configured or the learned effective track."""

    def __init__(self, multiplier: float) -> None:
        """Start with the configured track, which is `multiplier` times the wheel separation."""
        self._multiplier = multiplier
        self.use: TrackUse = "uncertain"
        """Whether the learned track is in use, or why it is not."""
        self.used = CONFIGURED
        """The effective track in use, configured or learned."""
        self.event: Event | None = None
        """Log event if the last call of `choose` changed `use`, otherwise None."""

    def choose(self, learned: Track | None) -> None:
        """Choose the effective track to use. `learned` is the track learned so far, or None.

        The method stores the chosen track in `used`, the reason in `use`, and a log event in
        `event`.
        """
        before, self.event = self.use, None
        self.use = _use(learned, before)
        self.used = learned if learned is not None and self.use == "used" else CONFIGURED
        if learned is not None and self.use != before:
            text = (
                "effective track, given as a value of wheel_separation_multiplier: "
                f"{beside(learned, self._multiplier, self.use)}"
            )
            level: Level = "warning" if self.use == "too far off" else "info"
            self.event = Event("learned_track", text, level, kind=self.use)


def _use(learned: Track | None, before: TrackUse) -> TrackUse:
    most = CERTAIN if before == "uncertain" else UNCERTAIN
    if learned is None or learned.deviation > most:
        return "uncertain"
    inwards = 1.0 if before == "used" else RANGE_HYSTERESIS
    within = TRACK_RATIO_RANGE[0] * inwards <= learned.share <= TRACK_RATIO_RANGE[1] / inwards
    return "used" if within else "too far off"


def beside(learned: Track, multiplier: float, use: TrackUse) -> str:
    """Return a text with the learned and the configured track, and which of the two is in use.

    The text gives both tracks as multiples of the wheel separation. `multiplier` is the multiple
    for the configured track.
    """
    value = learned.share * multiplier
    configured = "" if use == "used" else " (in use)"
    return (
        f"learned {value:.3f} ± {value * learned.deviation:.3f} {STATUS_TEXTS[use]}, "
        f"configured {multiplier:.3f}{configured}"
    )


def tracks(gyro: GyroStatus, multiplier: float) -> str:
    """Return a text with the learned and the configured track; "" before a track is learned.

    `multiplier` is the configured track divided by the wheel separation.
    """
    if gyro.track is None:
        return ""
    return beside(Track(gyro.track, gyro.track_deviation), multiplier, gyro.track_use)
