"""The true path of a robot in a room during a guided calibration, step by step.

This module uses none of the code under test.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Sequence

from acsard.calibration.guided.drive_plan import Leg, Setup
from acsard.calibration.guided.methods import METHODS

SIDE = 3.0
STEP_S = 0.05

ONCE_ROUND = 2 * math.pi + 0.2
"""Largest angle at which a person ends the first turn, rad."""

Start = tuple[complex, float]
"""Position of the robot's middle and its heading, rad.

The position is in m from the near right corner of the room.
"""


def places(
    start: Start, legs: Sequence[Leg], setup: Setup, track: float, bend: float
) -> Iterator[complex]:
    """Yield every position of the robot's centre during a drive.

    `track` is the true effective track divided by the geometric one. `bend` is how much larger the
    right wheels are than the left ones, as a fraction.
    """
    place, yaw = start
    geometric = setup.drive.wheel_separation
    believed = setup.drive.wheel_separation_multiplier * geometric
    for leg in legs:
        for move in leg.moves:
            left = move.linear - move.angular * believed / 2
            right = (move.linear + move.angular * believed / 2) * (1 + bend)
            begun = yaw
            for _ in range(round(move.seconds / STEP_S)):
                if leg.by_key and abs(yaw - begun) > ONCE_ROUND:
                    break
                yaw += (right - left) / (track * geometric) * STEP_S
                place += (left + right) / 2 * STEP_S * cmath.exp(1j * yaw)
                yield place


def beyond(way: str, setup: Setup, track: float, estimate: float, bend: float) -> float:
    """Return the distance by which a part of the robot leaves the room in the worst case, m.

    The distance is negative if the whole robot stays inside. A person puts the robot at its start
    before the first leg, and does not move it later.
    """
    legs = METHODS[way].legs(setup, estimate)
    assert "Place the" in legs[0].words
    start = complex(setup.reach + 0.1, SIDE / 2), 0.0
    return max(
        setup.reach - where
        for place in places(start, legs, setup, track, bend)
        for where in (place.real, SIDE - place.real, place.imag, SIDE - place.imag)
    )
