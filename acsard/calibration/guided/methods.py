"""The methods of calibration by a guided drive, and the legs of each method.

The method "umbmark" follows Borenstein & Feng, UMBmark: A Benchmark Test for Measuring Odometry
Errors in Mobile Robots (1995). The robot drives squares, and a person measures the displacement
between the start and the end of each square. The paper evaluates these measurements with two
formulas for small errors. Here the measurements go into the fit of `tape_readings.py` instead,
because the track of a robot that skids is far from the configured track.
"""

from __future__ import annotations

import math

from acsard.calibration.guided.drive_plan import (
    EDGE_MARGIN_M,
    FLOOR_M,
    MAX_TRACK_RATIO,
    Leg,
    Mean,
    Measure,
    Method,
    Move,
    Setup,
    Slant,
)  # fmt: skip
from acsard.calibration.multipliers import MIN_TAPE_M
from acsard.terminal.prompt import NumberQuestion

STRAIGHT_LEG_STD_M = 0.005
"""Standard deviation of the length of a straight drive that a person measures by tape, m.

It covers the errors at both ends of the tape.
"""

EYE_HEADING_STD = 0.07
"""Standard deviation of a heading that a person judges by eye, rad."""

END_STD_M = 0.003
"""Standard deviation of a distance between the robot and its marks after a square, m.

It includes the error with which the person made the marks beside the robot.
"""

FIRST_TURN_RATE = 1.2
"""Turn rate of the first turn in place, rad/s, if the robot does not skid."""

FIRST_TURN_TIMEOUT_FACTOR = 1.1
"""Timeout of the first turn, as a multiple of the longest time for a full turn.

The robot with the largest effective track (`MAX_TRACK_RATIO`) needs the longest time.
"""

MAX_SPIN_S = 24.0
"""Longest total time of the full turns in place in one leg, s."""

STOP, SETTLE = Move(0.6), Move(1.0)
"""Pauses between moves.

In `STOP`, the robot comes to rest. In `SETTLE`, the robot also stops shaking.
"""

ROUND_LEG = "once round"
"""Name of the leg in which the robot turns once in place, until the person presses a key."""

FROM_MARK = NumberQuestion(
    "How far is the marked wheel from its mark now, in a straight line?",
    "m", MIN_TAPE_M, 2 * FLOOR_M,
    name="metres",
)  # fmt: skip
DISTANCE = Mean("distance", ("metres",), STRAIGHT_LEG_STD_M)


def _at_the_edge(setup: Setup) -> str:
    return (
        f"Place the robot so that its middle is {setup.from_edge:.2f} m from the edge behind it, "
        f"on a free floor of {FLOOR_M:g} m x {FLOOR_M:g} m, and {FLOOR_M / 2:g} m from the edges "
        "to its left and right."
    )


def once_round(
    setup: Setup, until: str, asks: tuple[NumberQuestion, ...] = (), *measures: Measure
) -> Leg:
    """Return the leg of one left turn in place, which the person ends with a key.

    Args:
        setup: the robot, and the speeds of its drive.
        until: the words after "Press SPACE" in the instruction, such as "when it has turned ...".
        asks: the questions after the turn.
        measures: the measurements that follow from the answers.
    """
    longest = FIRST_TURN_TIMEOUT_FACTOR * 2 * math.pi * MAX_TRACK_RATIO
    rate = abs(setup.command(FIRST_TURN_RATE)) * setup.rate_per_command
    words = f"The robot turns left in place. Press SPACE {until}"
    turn = setup.spin(FIRST_TURN_RATE, longest / rate)
    return Leg(ROUND_LEG, words, (turn,), asks, measures, by_key=True)


def turns(setup: Setup, rate: float, track: float, most: int) -> int:
    """Return how many full turns in place fit into `MAX_SPIN_S`, from 1 to `most`.

    `rate` is the true turn rate, rad/s. `track` is the ratio of effective track to wheel
    separation.
    """
    turn_s = setup.turn(2 * math.pi, rate, track).seconds
    return max(1, min(most, int(MAX_SPIN_S / turn_s)))


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
LINE_ANSWERS = "front", "rear", "wheelbase"
"""Names of the answers for `Slant.near`, `Slant.far` and `Slant.apart`.

The answers describe a line on the left of the robot.
"""


def _tape(setup: Setup, track: float) -> tuple[Leg, ...]:
    def spun(how: str, side: int, rate: float, since: str) -> Leg:
        # `rate` is a true rate, rad/s. Two rates show how the track depends on the rate.
        count = turns(setup, rate, track, 3)
        around = setup.turn(side * 2 * math.pi * count, rate, track)
        to = "left" if side > 0 else "right"
        words = f"The robot turns {count} full circles to the {to}, {how}."
        measure = Slant("angle", *LINE_ANSWERS, since=since)
        return Leg(how, words, (SETTLE, around, SETTLE), TO_LINE, (measure,))

    around = once_round(
        setup,
        "when it has turned one full circle and faces along the line as before; an error of 20 deg "
        "does not matter.",
        TO_LINE,
        Slant("turned", *LINE_ANSWERS, since="ahead", plus=2 * math.pi, over=("back", ROUND_LEG)),
    )
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
            placed=True,
        ),
        Leg(
            "back",
            "The robot drives back to the middle of the floor.",
            (setup.ahead(-setup.to_middle), SETTLE),
        ),
        around,
        spun("slowly", -1, 0.6, ROUND_LEG),
        spun("fast", 1, 1.2, "slowly"),
    )


# The method "wall": a tape measure, and a wall against which a person sets the robot's back.

GAP_M = 0.2
"""Distance from the wall at which the robot stops when it returns, m."""

OUTWARD_M = 0.9
"""Distance that the robot drives away from the wall before several turns in place, m."""

HALF_RATE, ROUND_RATE = 0.8, 1.2
"""True turn rates in the method "wall", rad/s.

`HALF_RATE` is that of half turns, and `ROUND_RATE` that of several full turns.
"""

PLACE_ROBOT_BACK = (
    "Push the robot's back flat against the wall by hand, so that both its rear corners touch it"
)


def _corners(end: str) -> tuple[NumberQuestion, NumberQuestion]:
    return (
        NumberQuestion(
            f"How far is the robot's {end} left corner from the wall?", "mm", 0, 2500, name="left"
        ),
        NumberQuestion(
            f"How far is the robot's {end} right corner from the wall?", "mm", 0, 2500, name="right"
        ),
    )


# A turn to the left moves the rear left corner towards a wall behind the robot, and the front right
# corner towards a wall in front of it.
REAR, FRONT = ("left", "right", "rear width"), ("right", "left", "front width")


def _wall(setup: Setup, track: float) -> tuple[Leg, ...]:
    out, count = setup.ahead(setup.length), turns(setup, ROUND_RATE, track, 2)
    around = setup.turn(-2 * math.pi * count, ROUND_RATE, track)

    def there_and_back(to: str, side: int) -> Leg:
        half = setup.turn(side * math.pi, HALF_RATE, track)
        home = setup.ahead(setup.length - 2 * GAP_M)
        return Leg(
            f"half round to the {to}",
            f"{PLACE_ROBOT_BACK}. The robot drives away from the wall, turns half a circle to the "
            f"{to}, and drives back.",
            (STOP, out, STOP, half, STOP, home, STOP),
            _corners("front"),
            (Slant("angle", *FRONT, plus=side * math.pi),),
            placed=True,
        )

    return (
        Leg(
            "out",
            f"Along a straight wall, {FLOOR_M:g} m x {FLOOR_M:g} m must be free. "
            f"{PLACE_ROBOT_BACK}, in the "
            "middle of the free part of the wall. The robot drives straight away from the wall for "
            f"{setup.length:.2f} m.",
            (STOP, out, STOP),
            (
                NumberQuestion(
                    "How far is the robot's back from the wall now?", "m", MIN_TAPE_M, 2 * FLOOR_M,
                    name="metres",
                ),
            ),
            (DISTANCE,),
            placed=True,
        ),
        once_round(
            setup,
            "when it has turned one full circle and faces straight away from the wall as before; "
            "an error of 10 deg does not matter.",
        ),
        Leg(
            "home",
            "The robot drives back towards the wall.",
            (setup.ahead(GAP_M - setup.length), STOP),
            _corners("rear"),
            (Slant("turned", *REAR, plus=2 * math.pi, over=("out", ROUND_LEG, "home")),),
        ),
        there_and_back("left", 1),
        there_and_back("right", -1),
        Leg(
            "round at the wall",
            f"{PLACE_ROBOT_BACK}. The robot drives away from the wall, turns {count} full circles "
            "to the right, and drives back.",
            (
                STOP, setup.ahead(OUTWARD_M), STOP, around,
                STOP, setup.ahead(GAP_M - OUTWARD_M), STOP,
            ),
            _corners("rear"),
            (Slant("angle", *REAR),),
            placed=True,
        ),
    )  # fmt: skip


# The method "umbmark": squares in both directions, and marks on the floor.

CORNER_RATE = 0.9
"""True turn rate at the corners of the square in the method "umbmark", rad/s."""


def side_of_square(setup: Setup) -> float:
    """Return the side length of the square in the method "umbmark", m.

    It is 1.2 m, or less for a large robot.
    """
    return min(1.2, FLOOR_M - 2 * (setup.from_edge + 2 * EDGE_MARGIN_M))


def _umbmark(setup: Setup, track: float) -> tuple[Leg, ...]:
    edge = side_of_square(setup)
    marks = (
        "How far ahead of its mark is the middle of the robot's {} side (negative if behind it)?"
    )
    ends = (
        NumberQuestion(marks.format("left"), "mm", -1500, 1500, name="left"),
        NumberQuestion(marks.format("right"), "mm", -1500, 1500, name="right"),
        NumberQuestion(
            "How far to the left of its marks is the robot (negative if to the right of them)?",
            "mm", -1500, 1500, name="aside",
        ),
    )  # fmt: skip

    def square(to: str, other: str, side: int) -> Leg:
        corner = setup.turn(side * math.pi / 2, CORNER_RATE, track)
        return Leg(
            f"square to the {to}",
            f"Place the robot so that its middle is {(FLOOR_M - edge) / 2:.2f} m from the edge of "
            f"the floor behind it, and the same distance from the edge on its {other}. Make two "
            "marks on the floor: one exactly beside the middle of the robot's left side, one "
            "exactly beside the middle of its right side. The robot drives a square with sides of "
            f"{edge:.2f} m and all turns to the {to}, and ends about where it started.",
            (STOP, *(setup.ahead(edge), STOP, corner, STOP) * 4),
            ends,
            (
                Mean("ahead", ("left", "right"), END_STD_M),
                Mean("aside", ("aside",), END_STD_M),
                Slant("angle", "left", "right", "width"),
            ),
            placed=True,
        )

    return (
        Leg(
            "ahead",
            f"{_at_the_edge(setup)} Mark on the floor where one wheel stands. The robot drives "
            f"{setup.length:.2f} m straight ahead.",
            (STOP, setup.ahead(setup.length), STOP),
            (FROM_MARK,),
            (DISTANCE,),
            placed=True,
        ),
        once_round(
            setup,
            "exactly when it has turned one full circle and faces as before; the tool then asks "
            "how far past that point the robot has turned.",
            (
                NumberQuestion(
                    "How many degrees past a full circle did the robot turn (negative if less)?",
                    "deg", -90, 90, name="past",
                ),
            ),
            Mean("turned", ("past",), EYE_HEADING_STD, plus=2 * math.pi),
        ),
        square("left", "right", 1),
        square("right", "left", -1),
    )  # fmt: skip


# The methods "gyro" and "positions". Each drive goes there and back, so the robot stays on the
# floor although its effective track is unknown.

FAST, SLOW, CURVE = 1.5, 0.75, 0.8
"""Turn rates of fast turns, slow turns and curves, rad/s, if the robot does not skid."""

SPIN_S, CURVE_M, TURN_RAD = 7.5, 1.2, 5.0
"""Sizes of moves in the methods "gyro" and "positions".

- `SPIN_S`: the duration of a turn in place in "gyro", s.
- `CURVE_M`: the longest length of a curve, m.
- `TURN_RAD`: the angle of a turn in place in "positions", rad, if the robot does not skid.
"""

POSITION_MOVES = ((FAST, CURVE), (-FAST, -CURVE), (SLOW, 0.0), (-SLOW, CURVE), (FAST, -CURVE))
"""Moves of the method "positions": each pair is a turn in place, and a curve there and back.

The two numbers are the turn rates of the turn and of the curve, rad/s, if the robot does not skid.
A curve with the rate 0 is straight.
"""

STANDING, PAUSE, SHORT = Move(2.5), Move(1.4), Move(0.7)
"""Pauses: before the first drive, between drives, and where the robot only has to stop.

`STANDING` and `PAUSE` are long enough to measure the bias of a gyro.
"""

STRAIGHT_LEG = "straight"
"""Name of the leg straight ahead. In the method "gyro", a person may measure its length by tape."""


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
    """Return the moves of a curve forwards, and back on the same path.

    The curve is short enough that the robot stays on the floor, whatever its heading is.
    """
    metres = min(CURVE_M, FLOOR_M / 2 - setup.from_edge)
    return setup.arc(rate, metres), SHORT, setup.arc(-rate, -metres), SHORT


WHEELBASE = NumberQuestion(
    "How far apart are the front left and the rear left wheel, axle to axle?", "mm", 50, 2000,
    name="wheelbase",
)  # fmt: skip
REAR_WIDTH = NumberQuestion(
    "How far apart are the robot's rear corners, where they touch the wall?", "mm", 50, 2000,
    name="rear width",
)  # fmt: skip
FRONT_WIDTH = NumberQuestion(
    "How far apart are the robot's front corners?", "mm", 50, 2000, name="front width"
)
WIDTH = NumberQuestion("How wide is the robot, from side to side?", "mm", 50, 2000, name="width")

METHODS: dict[str, Method] = {
    "gyro": Method(_gyro),
    "positions": Method(_positions),
    "tape": Method(_tape, (WHEELBASE,), "a tape"),
    "wall": Method(_wall, (REAR_WIDTH, FRONT_WIDTH), "a wall"),
    "umbmark": Method(_umbmark, (WIDTH,), "UMBmark"),
}
