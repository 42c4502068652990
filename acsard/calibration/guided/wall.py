"""Calibration with a tape measure and a wall that the robot is set square against."""

from __future__ import annotations

import math

from acsard.calibration.guided.legs import ROOM, Leg, Move, Part, Setup, Way, ask, ride
from acsard.calibration.guided.measured import calibrated
from acsard.calibration.guided.readings import (
    Reading,
    deviation,
    effective,
    millimetres,
    once_round,
    slant,
    turns,
)  # fmt: skip
from acsard.calibration.tape_distance import LEAST_M

TAPE_M = 0.005
GAP_M = 0.2
"""Distance from the wall to which the robot returns, m."""

OUT_M = 0.9
"""Distance that the robot drives before the turns on the spot, m."""

HALF, FAST = 0.8, 1.2
"""True turn rates of the half turns and of the fast turns, rad/s."""

MOST_TURNS = 2
STANDING = Move(0.6)

SQUARE = (
    "Push the robot's back flat against the wall by hand, so that both its rear corners touch it"
)


def out(setup: Setup) -> Leg:
    """Return the first leg, away from the wall."""
    return Leg(
        f"Along a straight wall, {ROOM:g} m x {ROOM:g} m must be free. {SQUARE}, in the middle of "
        f"that. It drives {setup.length:.2f} m away from the wall.",
        (STANDING, setup.ahead(setup.length), STANDING),
    )


def first_turn(setup: Setup) -> Leg:
    """Return the first turn, which a person ends with a key."""
    return once_round(
        setup,
        "It turns to the left, on the spot. Press SPACE when it has turned once round and looks "
        "straight away from the wall as before; 10 deg too far or too short do not matter.",
    )


def home(setup: Setup) -> Leg:
    """Return the leg backwards to the wall."""
    return Leg("It drives back towards the wall.", (setup.ahead(GAP_M - setup.length), STANDING))


def there_and_back(setup: Setup, side: int, track: float) -> Leg:
    """Return a leg away from the wall, half a turn, and back forwards."""
    half = setup.turn(side * math.pi, HALF, track)
    which = "left" if side > 0 else "right"
    return Leg(
        f"{SQUARE}. It drives away from the wall, turns half round to the {which}, and drives "
        "back.",
        (
            STANDING, setup.ahead(setup.length), STANDING, half, STANDING,
            setup.ahead(setup.length - 2 * GAP_M), STANDING,
        ),
    )  # fmt: skip


def spun(setup: Setup, track: float) -> Leg:
    """Return a leg away from the wall, some turns, and back."""
    count = turns(setup, FAST, track, MOST_TURNS)
    around = setup.turn(-2 * math.pi * count, FAST, track)
    return Leg(
        f"{SQUARE}. It drives away from the wall, turns {count} times round to the right, and "
        "drives back.",
        (
            STANDING, setup.ahead(OUT_M), STANDING, around, STANDING, setup.ahead(GAP_M - OUT_M),
            STANDING,
        ),
    )  # fmt: skip


def longest_s(setup: Setup, track: float) -> float:
    """Return the driving time in s for a ratio of effective to geometric track."""
    legs = [out(setup), first_turn(setup), home(setup), spun(setup, track)]
    legs += [there_and_back(setup, side, track) for side in (1, -1)]
    return sum(leg.seconds for leg in legs)


def way(setup: Setup) -> Way:
    """Calibrate with a wall."""
    apart = yield from millimetres(
        "How far apart are the robot's rear corners, where they touch the wall?", 50, 2000
    )
    front = yield from millimetres("And its front corners?", 50, 2000)
    first = yield from ride(out(setup))
    metres = yield from ask(
        "How far is the robot's back from the wall now?", "m", LEAST_M, 2 * ROOM
    )
    readings = [Reading((first,), "distance", metres, TAPE_M)]
    round_ = yield from ride(first_turn(setup))
    last = yield from ride(home(setup))
    angle = yield from _off(apart, "rear")
    once = Reading((first, round_, last), "turned", 2 * math.pi + angle, deviation(apart))
    track = effective(once, setup.drive)
    readings.append(once)
    for side in (1, -1):
        ridden = yield from ride(there_and_back(setup, side, track))
        angle = yield from _off(front, "front")
        readings.append(Reading((ridden,), "angle", side * math.pi + angle, deviation(front)))
    ridden = yield from ride(spun(setup, track))
    angle = yield from _off(apart, "rear")
    readings.append(Reading((ridden,), "angle", angle, deviation(apart)))
    return calibrated("a wall", readings, setup.drive)


def _off(apart: float, end: str) -> Part[float]:
    """Ask for the distances of two corners from the wall and return the heading error.

    The result is in rad, positive to the left, and 0 if the robot is square to the wall. `end` is
    the end of the robot that faces the wall.
    """
    left = yield from millimetres(f"From the wall to the robot's {end} left corner?", 0, 2500)
    right = yield from millimetres(f"And to its {end} right corner?", 0, 2500)
    # If the robot looks too far to the left, its left corner is closer to the wall when its back
    # faces the wall, and farther from it when its front does.
    return slant(left, right, apart) if end == "rear" else slant(right, left, apart)
