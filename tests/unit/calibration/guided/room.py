"""The true path of a robot in a room during a guided calibration, step by step.

This module uses none of the code under test.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Sequence

from acsard.calibration.guided.drive_plan import Leg, Setup
from acsard.calibration.guided.methods import METHODS, side_of_square

SIDE = 3.0
STEP_S = 0.05

ONCE_ROUND = 2 * math.pi + 0.2
"""Largest angle at which a person ends the first turn, rad."""

Start = tuple[complex, float]
"""Position of the robot's middle and its heading, rad.

The position is in m from the near right corner of the room.
"""

Drive = tuple[Start, Sequence[Leg]]
"""Start pose and the legs that follow it without a person moving the robot by hand."""


def drives(way: str, setup: Setup, track: float) -> Iterator[Drive]:
    """Yield every drive of a calibration whose estimated track is `track`.

    Before the first leg of a drive a person puts the robot at its start. In the poses x is forward
    and y is left.
    """
    aside = (SIDE - side_of_square(setup)) / 2
    starts: dict[str, Start] = {
        "square to the left": (complex(aside, aside), 0.0),
        "square to the right": (complex(aside, SIDE - aside), 0.0),
    }
    drive: list[Leg] = []
    for leg in reversed(METHODS[way].legs(setup, track)):
        drive.insert(0, leg)
        if any(words in leg.words for words in ("Push", "Place the")):
            edge = setup.reach + (0.0 if way == "wall" else 0.1)
            yield starts.get(leg.name, (complex(edge, SIDE / 2), 0.0)), drive
            drive = []
    assert not drive, "nobody says where the first leg begins"


def places(drive: Drive, setup: Setup, track: float, bend: float) -> Iterator[complex]:
    """Yield every position of the robot's centre during a drive.

    `track` is the true effective track divided by the geometric one. `bend` is how much larger the
    right wheels are than the left ones, as a fraction.
    """
    (place, yaw), legs = drive
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

    The distance is negative if the whole robot stays inside. The robot may touch the wall where the
    person pushes it against that wall.
    """
    most = -SIDE
    for drive in drives(way, setup, estimate):
        for place in places(drive, setup, track, bend):
            for where in (place.real, SIDE - place.real, place.imag, SIDE - place.imag):
                most = max(most, setup.reach - where)
    return most
