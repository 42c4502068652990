"""Turns on the spot, first until a person says so, then by what that told; and what is read off."""

from __future__ import annotations

import math

from acsard.calibration.doubts import RefusedError
from acsard.calibration.evidence import Base
from acsard.calibration.guided.readings import Reading, joined, predicted
from acsard.calibration.guided.setup import WIDEST, Setup
from acsard.calibration.guided.steps import GuideError, Leg, Part, ask
from acsard.config.settings import DriveConfig

READ_M = 0.002
"""Standard deviation of a distance of a few decimetres, and of setting the robot to a line."""

FIRST = 1.2
"""rad/s that the wheels turn against each other, as if they did not skid, in the first turn."""

LATE = 1.1
"""A first turn that takes longer than this times the slowest has been missed."""

MOST_SPIN_S = 24.0
"""For some turns on the spot."""

BELIEVABLE = 0.85, 3.0
"""Effective track over the geometric one: what lies beyond was misread."""


def once_round(setup: Setup, words: str) -> Leg:
    """A turn to the left that a key ends."""
    longest = LATE * 2 * math.pi * WIDEST
    rate = abs(setup.command(FIRST)) * setup.drive.wheel_separation_multiplier
    return Leg(words, (setup.spin(FIRST, longest / rate),), by_key=True)


def turns(setup: Setup, rate: float, track: float, most: int) -> int:
    """As many whole turns at this rate as there is time for; at least one."""
    one = setup.turn(2 * math.pi, rate, track).seconds
    return max(1, min(most, int(MOST_SPIN_S / one)))


def effective(reading: Reading, drive: DriveConfig) -> float:
    """Effective over geometric track, about, by one reading of turns; raises `GuideError`."""
    # Of wheels and a track as measured, so that what is configured does not matter.
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
    """rad of a robot that is `near` and `far` from a line, at two points so far apart; raises
    `RefusedError`."""
    share = (far - near) / apart
    if abs(share) > 0.98:
        raise RefusedError(
            f"points {apart * 1000:.0f} mm apart cannot be {near * 1000:.0f} and "
            f"{far * 1000:.0f} mm from the line: measure again from the start"
        )
    return math.asin(share)


def millimetres(words: str, least: float, most: float) -> Part[float]:
    """A length, asked in mm, in m."""
    length = yield from ask(words, "mm", least, most)
    return length / 1000.0


def deviation(apart: float) -> float:
    """rad, of the difference of two slants; each is of two distances."""
    return 2 * READ_M / apart
