"""UMBmark: drives a square in both directions and measures how far its end is from its start.

Borenstein & Feng, UMBmark: A Benchmark Test for Measuring Odometry Errors in Mobile Robots (1995).
They use two formulas for small errors. Here the same measurements go into the general fit, because
the effective track of a robot that skids is not a small error.
"""

from __future__ import annotations

import math

from acsard.calibration.guided.legs import EDGE, ROOM, Leg, Move, Part, Setup, Way, ask, ride
from acsard.calibration.guided.measured import calibrated
from acsard.calibration.guided.readings import (
    Reading,
    deviation,
    effective,
    millimetres,
    once_round,
    slant,
)  # fmt: skip
from acsard.calibration.runs import Run
from acsard.calibration.tape_distance import LEAST_M

SIDE_M = 1.2
TURN = 0.9
"""True turn rate at the corners, rad/s."""

STANDING = Move(0.6)
TAPE_M = 0.005

BY_EYE = 0.07
"""Standard deviation of a heading that a person judges by eye, rad."""

END_M = 0.003
"""Standard deviation of the end position relative to the marks, m.

It includes the error of placing the robot on them.
"""


def straight(setup: Setup) -> Leg:
    """Return a straight leg, which measures the size of the wheels."""
    return Leg(
        f"Set the robot {setup.from_edge:.2f} m (its middle) from the near edge of a free floor of "
        f"{ROOM:g} m x {ROOM:g} m, {ROOM / 2:g} m from both sides, looking to the far edge. Mark "
        f"where one wheel stands. It drives {setup.length:.2f} m straight ahead.",
        (STANDING, setup.ahead(setup.length), STANDING),
    )


def first_turn(setup: Setup) -> Leg:
    """Return the first turn, which a person ends with a key."""
    return once_round(
        setup,
        "It turns to the left, on the spot. Press SPACE just when it has turned once round and "
        "looks as before; what it rolls on behind that is asked for.",
    )


def square(setup: Setup, side: int, track: float) -> Leg:
    """Return the square: four sides, each followed by a quarter turn.

    `side` is 1 for left, -1 for right.
    """
    which, other = ("left", "right") if side > 0 else ("right", "left")
    turn = setup.turn(side * math.pi / 2, TURN, track)
    edge = length(setup)
    return Leg(
        f"Set the robot's middle {(ROOM - edge) / 2:.2f} m from the near edge and as far from the "
        f"{other} one, looking to the far edge. Mark on the floor exactly beside the middle of "
        f"its left and of its right side. It drives a square of {edge:.2f} m, round to the "
        f"{which}, and ends about where it began.",
        (STANDING, *(setup.ahead(edge), STANDING, turn, STANDING) * 4),
    )


def length(setup: Setup) -> float:
    """Return the length of the square's side, m."""
    return min(SIDE_M, ROOM - 2 * (setup.from_edge + 2 * EDGE))


def longest_s(setup: Setup, track: float) -> float:
    """Return the driving time in s for a ratio of effective to geometric track."""
    legs = (straight(setup), first_turn(setup), *(square(setup, side, track) for side in (1, -1)))
    return sum(leg.seconds for leg in legs)


def way(setup: Setup) -> Way:
    """Calibrate by UMBmark."""
    apart = yield from millimetres("How wide is the robot, from side to side?", 50, 2000)
    first = yield from ride(straight(setup))
    metres = yield from ask(
        "How far is that wheel from its mark now, in a straight line?", "m", LEAST_M, 2 * ROOM
    )
    round_ = yield from ride(first_turn(setup))
    past = yield from ask(
        "How many degrees past once round does it look (short of it: less than 0)?", "deg", -90, 90
    )
    once = Reading((round_,), "turned", 2 * math.pi + math.radians(past), BY_EYE)
    track = effective(once, setup.drive)
    readings = [Reading((first,), "distance", metres, TAPE_M), once]
    for side in (1, -1):
        driven = yield from ride(square(setup, side, track))
        readings += yield from _end(driven, apart)
    return calibrated("UMBmark", readings, setup.drive)


def _end(driven: Run, apart: float) -> Part[list[Reading]]:
    """Ask where a square ended relative to its start and return the readings."""
    words = "How far ahead of its mark is the middle of its {} side (behind it: less than 0)?"
    left = yield from millimetres(words.format("left"), -1500, 1500)
    right = yield from millimetres(words.format("right"), -1500, 1500)
    aside = yield from millimetres(
        "How far to the left of its marks is the robot (to the right: less than 0)?", -1500, 1500
    )
    return [
        Reading((driven,), "ahead", (left + right) / 2, END_M),
        Reading((driven,), "aside", aside, END_M),
        Reading((driven,), "angle", slant(left, right, apart), deviation(apart)),
    ]
