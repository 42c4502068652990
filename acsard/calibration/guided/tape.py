"""Calibration with a tape measure alone, beside a straight line on the floor."""

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
"""Standard deviation of the long distance, including the position of its ends, m."""

RATES = 0.6, 1.2
"""True rates of the later turns, rad/s."""

MOST_TURNS = 3
STANDING = Move(1.0)


def straight(setup: Setup) -> Leg:
    """Return the first leg, straight ahead."""
    return Leg(
        f"On a free floor of {ROOM:g} m x {ROOM:g} m, find or draw a straight line across its "
        "middle (a joint of tiles, a board, chalk). Set the robot to the right of the line, about "
        f"300 mm off, its middle {setup.from_edge:.2f} m from the near edge, looking along the "
        "line, so that its front left and rear left wheel are equally far from it, to the "
        "millimetre. Mark where one wheel stands. Do not move it by hand until all is done. It "
        f"drives {setup.length:.2f} m straight ahead.",
        (STANDING, setup.ahead(setup.length), STANDING),
    )


def back(setup: Setup) -> Leg:
    """Return the leg back to the middle of the floor."""
    return Leg("It drives back to the middle.", (setup.ahead(-setup.to_middle), STANDING))


def first_turn(setup: Setup) -> Leg:
    """Return the first turn, which a person ends with a key."""
    return once_round(
        setup,
        "It turns to the left, on the spot. Press SPACE when it has turned once round and looks "
        "along the line as before; 20 deg too far or too short do not matter.",
    )


def spin(setup: Setup, number: int, track: float) -> Leg:
    """Return one of the later turns: number 0 is slow to the right, number 1 fast to the left."""
    rate, side = RATES[number], (-1, 1)[number]
    count = turns(setup, rate, track, MOST_TURNS)
    move = setup.turn(side * 2 * math.pi * count, rate, track)
    way = f"{('right', 'left')[number]}, {('slowly', 'fast')[number]}"
    return Leg(f"It turns {count} times round to the {way}.", (STANDING, move, STANDING))


def longest_s(setup: Setup, track: float) -> float:
    """Return the driving time in s for a ratio of effective to geometric track."""
    legs = (straight(setup), back(setup), first_turn(setup))
    return sum(leg.seconds for leg in legs) + sum(
        spin(setup, number, track).seconds for number in (0, 1)
    )


def way(setup: Setup) -> Way:
    """Calibrate with a tape measure."""
    apart = yield from millimetres(
        "How far apart are the front left and the rear left wheel, axle to axle?", 50, 2000
    )
    sure = deviation(apart)
    first = yield from ride(straight(setup))
    metres = yield from ask(
        "How far is that wheel from its mark now, in a straight line?", "m", LEAST_M, 2 * ROOM
    )
    angle = yield from _along(apart)
    readings = [
        Reading((first,), "distance", metres, TAPE_M),
        Reading((first,), "angle", angle, sure),
    ]
    home = yield from ride(back(setup))
    round_ = yield from ride(first_turn(setup))
    now = yield from _along(apart)
    once = Reading((home, round_), "turned", 2 * math.pi + now - angle, sure)
    track = effective(once, setup.drive)
    readings.append(once)
    for number in (0, 1):
        spun = yield from ride(spin(setup, number, track))
        before, now = now, (yield from _along(apart))
        readings.append(Reading((spun,), "angle", now - before, sure))
    return calibrated("a tape", readings, setup.drive)


def _along(apart: float) -> Part[float]:
    """Ask for two distances and return the robot's angle to the line, rad, positive to the left."""
    front = yield from millimetres("Front left wheel to the line, at a right angle to it?", 0, 1500)
    rear = yield from millimetres("Rear left wheel to the line?", 0, 1500)
    return slant(front, rear, apart)
