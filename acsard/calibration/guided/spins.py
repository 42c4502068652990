"""Turns on the spot and the readings after them.

A person ends the first turn with a key. The later turns use the track that the first one showed.
"""

from __future__ import annotations

import math

from acsard.calibration.doubts import RefusedError
from acsard.calibration.evidence import Base
from acsard.calibration.guided.readings import Reading, joined, predicted
from acsard.calibration.guided.setup import WIDEST, Setup
from acsard.calibration.guided.steps import GuideError, Leg, Part, ask
from acsard.config.settings import DriveConfig

READ_M = 0.002
"""Standard deviation of a distance of a few decimetres, and of placing the robot on a line, m."""

FIRST = 1.2
"""Rate of the first turn as it would be without skidding, rad/s."""

LATE = 1.1
"""Timeout of the first turn, as a multiple of the duration with the widest track.

Beyond it, the person has missed the end of the turn.
"""

MOST_SPIN_S = 24.0
"""Longest time for several turns on the spot, s."""

BELIEVABLE = 0.85, 3.0
"""Credible ratios of effective to geometric track. Outside them, a reading must be wrong."""


def once_round(setup: Setup, words: str) -> Leg:
    """Return a leg that turns to the left until a key is pressed."""
    longest = LATE * 2 * math.pi * WIDEST
    rate = abs(setup.command(FIRST)) * setup.drive.wheel_separation_multiplier
    return Leg(words, (setup.spin(FIRST, longest / rate),), by_key=True)


def turns(setup: Setup, rate: float, track: float, most: int) -> int:
    """Return the number of whole turns that fit into `MOST_SPIN_S`, from 1 to `most`."""
    one = setup.turn(2 * math.pi, rate, track).seconds
    return max(1, min(most, int(MOST_SPIN_S / one)))


def effective(reading: Reading, drive: DriveConfig) -> float:
    """Return the approximate ratio of effective to geometric track by one reading of turns.

    Raises `GuideError` if it is not credible.
    """
    # Use the measured radius and separation without the configured multipliers.
    base = Base(drive.wheel_radius, drive.wheel_separation, 1.0, 1.0, 1.0)
    told = predicted(joined(reading.rides), "turned", base, base.start()).value
    track = told / reading.value
    least, most = BELIEVABLE
    if not least < track < most:
        raise GuideError(
            f"once round, its wheels say {math.degrees(told):.0f} deg: was it one whole turn, and "
            "are drive.wheel_radius and drive.wheel_separation what a tape says? Begin again"
        )
    return min(WIDEST, max(1.0, track))


def slant(near: float, far: float, apart: float) -> float:
    """Return the angle in rad of a robot relative to a line.

    `near` and `far` are the distances from the line to two points of the robot that are `apart` m
    from each other. Raises `RefusedError` if that is impossible.
    """
    share = (far - near) / apart
    if abs(share) > 0.98:
        raise RefusedError(
            f"points {apart * 1000:.0f} mm apart cannot be {near * 1000:.0f} and "
            f"{far * 1000:.0f} mm from the line: measure again from the start"
        )
    return math.asin(share)


def millimetres(words: str, least: float, most: float) -> Part[float]:
    """Ask for a length in mm and return it in m."""
    length = yield from ask(words, "mm", least, most)
    return length / 1000.0


def deviation(apart: float) -> float:
    """Return the standard deviation of the difference of two slants, rad.

    Each has two distances.
    """
    return 2 * READ_M / apart
