"""The methods of calibration by a guided drive, and the legs of each method."""

from __future__ import annotations

import math

from acsard.calibration.guided.drive_plan import (
    FLOOR_M,
    MAX_TRACK_RATIO,
    Distance,
    Leg,
    Method,
    Move,
    Setup,
    Slant,
)  # fmt: skip
from acsard.calibration.multipliers import MIN_TAPE_M
from acsard.terminal.prompt import NumberQuestion

STRAIGHT_LEG_STD_M = 0.005  # of both ends of the tape

FIRST_TURN_RATE = 1.2  # turn rate of the first turn in place, rad/s, if the robot does not skid

FIRST_TURN_TIMEOUT_FACTOR = 1.1  # of the time of the robot with the largest effective track

MAX_SPIN_S = 24.0  # longest total time of the full turns in place in one leg

SETTLE = Move(1.0)  # pause between moves, in which the robot comes to rest and stops shaking

ROUND_LEG = "once round"  # one turn in place, until the person presses a key

FROM_MARK = NumberQuestion(
    "How far is the marked wheel from its mark now, in a straight line?",
    "m", MIN_TAPE_M, 2 * FLOOR_M,
    name="metres",
)  # fmt: skip
DISTANCE = Distance("metres", STRAIGHT_LEG_STD_M)


def _at_the_edge(setup: Setup) -> str:
    return (
        f"Place the robot so that its middle is {setup.from_edge:.2f} m from the edge behind it, "
        f"on a free floor of {FLOOR_M:g} m x {FLOOR_M:g} m, and {FLOOR_M / 2:g} m from the edges "
        "to its left and right."
    )


def once_round(setup: Setup) -> Leg:
    """Return the leg of one left turn in place, which the person ends with a key."""
    longest = FIRST_TURN_TIMEOUT_FACTOR * 2 * math.pi * MAX_TRACK_RATIO
    rate = abs(setup.command(FIRST_TURN_RATE)) * setup.rate_per_command
    words = (
        "The robot turns left in place. Press SPACE when it has turned one full circle and faces "
        "along the line as before; an error of 20 deg does not matter."
    )
    turn = setup.spin(FIRST_TURN_RATE, longest / rate)
    measure = Slant(
        "turned", *LINE_ANSWERS, since="ahead", plus=2 * math.pi, over=("back", ROUND_LEG)
    )
    return Leg(ROUND_LEG, words, (turn,), TO_LINE, (measure,), by_key=True)


def turns(setup: Setup, rate: float, track: float) -> int:
    """Return how many full turns in place fit into `MAX_SPIN_S`, from 1 to 3."""
    turn_s = setup.turn(2 * math.pi, rate, track).seconds
    return max(1, min(3, int(MAX_SPIN_S / turn_s)))


# The method "tape": a tape measure, and a straight line on the floor.

TO_LINE = (
    NumberQuestion(
        "How far is the front left wheel from the line, measured at a right angle to the line?",
        "mm",
        0,
        1500,
        name="front",
    ),
    NumberQuestion(
        "How far is the rear left wheel from the line, measured in the same way?",
        "mm",
        0,
        1500,
        name="rear",
    ),
)
# For `Slant.near`, `far` and `apart`, of a line on the left of the robot.
LINE_ANSWERS = "front", "rear", "wheelbase"


def _tape(setup: Setup, track: float) -> tuple[Leg, ...]:
    def spun(how: str, side: int, rate: float, since: str) -> Leg:
        # `rate` is a true rate, rad/s. Two rates show how the track depends on the rate.
        count = turns(setup, rate, track)
        around = setup.turn(side * 2 * math.pi * count, rate, track)
        to = "left" if side > 0 else "right"
        words = f"The robot turns {count} full circles to the {to}, {how}."
        measure = Slant("angle", *LINE_ANSWERS, since=since)
        return Leg(how, words, (SETTLE, around, SETTLE), TO_LINE, (measure,))

    return (
        Leg(
            "ahead",
            f"On a free floor of {FLOOR_M:g} m x {FLOOR_M:g} m, find or draw a straight line "
            "across its middle (a joint of tiles, a board, chalk). Place the robot to the right "
            f"of the line, about 300 mm away, its middle {setup.from_edge:.2f} m from the edge "
            "behind it, facing along the line. Its front left and its rear left wheel must have "
            "the same distance from the line, to the millimetre. Mark on the floor where one "
            "wheel stands. Do not move the robot by hand until the calibration is done. The robot "
            f"drives {setup.length:.2f} m straight ahead.",
            (SETTLE, setup.ahead(setup.length), SETTLE),
            (FROM_MARK, *TO_LINE),
            (DISTANCE, Slant("angle", *LINE_ANSWERS)),
        ),
        Leg(
            "back",
            "The robot drives back to the middle of the floor.",
            (setup.ahead(-setup.to_middle), SETTLE),
        ),
        once_round(setup),
        spun("slowly", -1, 0.6, ROUND_LEG),
        spun("fast", 1, 1.2, "slowly"),
    )


# The methods "gyro" and "positions". Each drive goes there and back, so the robot stays on the
# floor.

# Turn rates of fast turns, slow turns and curves, rad/s, if the robot does not skid.
FAST, SLOW, CURVE = 1.5, 0.75, 0.8

# Of a turn in place in "gyro", of a curve, and of a turn in place in "positions", without skidding.
SPIN_S, CURVE_M, TURN_RAD = 7.5, 1.2, 5.0

# Turn rates of a turn in place, and of a curve there and back; 0 is straight.
POSITION_MOVES = ((FAST, CURVE), (-FAST, -CURVE), (SLOW, 0.0), (-SLOW, CURVE), (FAST, -CURVE))

# The first two are long enough to measure the bias of a gyro.
STANDING, PAUSE, SHORT = Move(2.5), Move(1.4), Move(0.7)

STRAIGHT_LEG = "straight"  # in the method "gyro", a person may measure its length by tape


def _straight(setup: Setup, asks: tuple[NumberQuestion, ...] = ()) -> Leg:
    return Leg(
        STRAIGHT_LEG,
        f"{_at_the_edge(setup)} Mark on the floor where one of its wheels stands. Do not move the "
        "robot by hand until the calibration is done. The robot stands for "
        f"{STANDING.seconds:g} s, then drives {setup.length:.2f} m straight ahead.",
        (STANDING, setup.ahead(setup.length), PAUSE),
        asks,
    )


def _gyro(setup: Setup, track: float) -> tuple[Leg, ...]:
    moves = [PAUSE, setup.ahead(-setup.to_middle), PAUSE]
    for rate in (FAST, -FAST, SLOW, -SLOW):
        moves += [setup.spin(rate, SPIN_S), PAUSE]
    for rate in (CURVE, -CURVE, 0.0):
        moves += _there_and_back(setup, rate)
    far = NumberQuestion(
        "How far is the marked wheel from its mark now, in a straight line? If you did not measure "
        "it, press only Enter",
        "m", 0.0, 2 * setup.length, 0.0, "metres",
    )  # fmt: skip
    return (
        _straight(setup, (far,)),
        Leg(
            "turns",
            "The robot drives back to the middle of the floor, turns in place to both sides, fast "
            "and slowly, and drives three curves there and back.",
            (*moves, PAUSE),
        ),
    )


def _positions(setup: Setup, track: float) -> tuple[Leg, ...]:
    # Positions show a turn in place only by the direction of the curve that follows it.
    moves = [SHORT, setup.ahead(-setup.to_middle), SHORT]
    for turn_rate, curve_rate in POSITION_MOVES:
        moves += [setup.spin(turn_rate, TURN_RAD / abs(turn_rate)), SHORT]
        moves += _there_and_back(setup, curve_rate)
    return (
        _straight(setup),
        Leg(
            "turns",
            "The robot drives back to the middle of the floor. Then it repeatedly turns in place "
            "by a part of a circle, and drives a curve there and back.",
            tuple(moves),
        ),
    )


def _there_and_back(setup: Setup, rate: float) -> tuple[Move, ...]:
    metres = min(CURVE_M, FLOOR_M / 2 - setup.from_edge)
    return setup.arc(rate, metres), SHORT, setup.arc(-rate, -metres), SHORT


WHEELBASE = NumberQuestion(
    "How far apart are the front left and the rear left wheel, axle to axle?", "mm", 50, 2000,
    name="wheelbase",
)  # fmt: skip

METHODS: dict[str, Method] = {
    "gyro": Method(_gyro),
    "positions": Method(_positions),
    "tape": Method(_tape, (WHEELBASE,), by_tape=True),
}
