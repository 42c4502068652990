"""The legs of a guided drive, as data: with a gyro, with poses, or with a tape.

A leg is a series of moves that a person starts with Enter and stops with any key. All legs stay on
a floor of 3 m x 3 m, for each effective track of 1 to 2.5 times the wheel separation: they go out
and back on the same path, are straight from a known pose, or follow a turn that a person measured.
"""

from __future__ import annotations

import math

from msgspec import Struct
from msgspec.structs import replace

from acsard.calibration.log import LogError
from acsard.core.config.settings import Config, DriveConfig
from acsard.core.formatting import many
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import Metres, RadPerS, Seconds, Twist
from acsard.terminal.prompt import NumberQuestion

# What the person needs, by the name in `--method`.
METHODS = {
    "gyro": "a gyro on the Zenoh key imu, and perhaps a tape measure",
    "poses": "poses or positions of the robot on a Zenoh key",
    "tape": "a tape measure and a straight line on the floor",
}

STAY = "Do not move the robot by hand until the calibration is done. "

FLOOR_M, EDGE_M = 3.0, 0.1
REACH = 0.75  # assumed distance from the middle to the outermost point / wheel separation
SPEED, ROLLING_SPEED = 0.3, 0.5  # m/s straight ahead, and of the wheels in turns
LENGTHS_M = 0.8, 2.0  # of the straight leg
LEAST = Twist(0.05, 0.2)  # limits below which no guided drive is possible
STOP_M = 0.1
MAX_TRACK = 2.5  # effective track / wheel separation

FAST, SLOW, CURVE = 1.5, 0.75, 0.8  # rad/s of a robot that does not skid
CURVE_M, TURN_RAD = 1.2, 5.0
# Turn rates of a turn in place, and of a curve there and back; 0 is straight. Positions show a turn
# in place only by the direction of the curve that follows it.
MOVES = ((FAST, CURVE), (-FAST, -CURVE), (SLOW, 0.0), (-SLOW, CURVE), (FAST, -CURVE))
ROUND_RATE, TAPE_RATES, MAX_SPIN_S = 1.2, (0.6, 1.2), 24.0


class Move(Struct, frozen=True):
    """A twist and its time; a pause if the twist is zero."""

    seconds: Seconds
    linear: float = 0.0
    angular: RadPerS = 0.0


class Leg(Struct, frozen=True):
    name: str
    words: str  # what the person does, and how the robot will move
    moves: tuple[Move, ...]
    asks: tuple[NumberQuestion, ...] = ()  # after the moves
    whole_turns: float = 0.0  # rad, that the distances to the line do not show
    by_key: bool = False  # the person ends the last move with a key; its time is a timeout

    @property
    def seconds(self) -> Seconds:
        return sum(move.seconds for move in self.moves)


FROM_MARK = NumberQuestion(
    "How far is the marked wheel from its mark now, in a straight line?", "mm", 500,
    2000 * FLOOR_M, name="distance",
)  # fmt: skip
TO_LINE = tuple(
    NumberQuestion(
        f"How far is the {end} point from the line, measured at a right angle to the line?",
        "mm", 0, 1500, name=end,
    )
    for end in ("front", "rear")
)  # fmt: skip
WHEELBASE = NumberQuestion(
    "Choose two points on the left side of the robot, a front and a rear one, equally far to the "
    "left: the axles of two wheels, or two screws. How far apart are they?", "mm", 50, 2000,
    name="wheelbase",
)  # fmt: skip


class Setup(Struct, frozen=True):
    """The robot, and the speeds and lengths of its guided drive."""

    drive: DriveConfig
    speed: float
    length: Metres  # of the straight leg
    reach: Metres  # from the middle to the outermost point
    max_rate: RadPerS  # in a command
    rolling_speed: float

    @classmethod
    def of(cls, config: Config) -> Setup:
        """Raise `LogError` if the robot is too large or its limits are too low."""
        drive, limits = config.drive, config.limits
        rolling = min(ROLLING_SPEED, 0.9 * limits.wheel_speed * drive.wheel_radius)
        stopping = math.sqrt(2 * STOP_M * limits.linear_deceleration)
        speed = min(SPEED, limits.linear_speed, stopping, rolling)
        if speed < LEAST.linear or limits.angular_speed < LEAST.angular:
            raise LogError(
                f"the calibration needs {LEAST.linear} m/s and {LEAST.angular} rad/s, but the "
                "limits are lower: raise limits.linear_speed, limits.angular_speed, "
                "limits.wheel_speed or limits.linear_deceleration, or use `acsard calibrate log`"
            )
        reach = REACH * drive.wheel_separation + drive.wheel_radius / 2
        length = min(LENGTHS_M[1], FLOOR_M - 2 * (reach + EDGE_M) - STOP_M)
        if length < LENGTHS_M[0]:
            raise LogError(
                f"a robot with drive.wheel_separation = {drive.wheel_separation:g} is too large "
                f"for a floor of {FLOOR_M:g} m x {FLOOR_M:g} m: record a drive on a larger floor, "
                "and use `acsard calibrate log`"
            )
        return cls(drive, speed, length, reach, limits.angular_speed, rolling)

    @property
    def from_edge(self) -> Metres:
        return self.reach + EDGE_M

    @property
    def rate_per_command(self) -> float:
        """Turn rate without skidding, rad/s, of a command of 1 rad/s: multipliers change it."""
        bare = replace(
            self.drive, wheel_separation_multiplier=1.0, left_wheel_radius_multiplier=1.0,
            right_wheel_radius_multiplier=1.0,
        )  # fmt: skip
        wheels = Kinematics(self.drive).wheel_speeds(Twist(0.0, 1.0))
        return Kinematics(bare).twist(wheels).angular

    def command(self, rate: RadPerS) -> RadPerS:
        """Return the command for a turn at `rate` without skidding, within the limits."""
        most = 2 * self.rolling_speed / self.drive.wheel_separation
        most = min(most, self.max_rate * self.rate_per_command)
        return max(-most, min(most, rate)) / self.rate_per_command

    def ahead(self, metres: Metres) -> Move:
        return Move(abs(metres) / self.speed, math.copysign(self.speed, metres))

    def arc(self, rate: RadPerS, metres: Metres) -> Move:
        straight = self.ahead(metres)
        return Move(straight.seconds, straight.linear, self.command(rate))

    def spin(self, angle: float, rate: RadPerS, track: float = 1.0) -> Move:
        """Return a turn in place; `track` is effective track / separation, `angle` left is +."""
        command = abs(self.command(rate * track))
        seconds = abs(angle) * track / (command * self.rate_per_command)
        return Move(seconds, 0.0, math.copysign(command, angle))


PAUSE = Move(1.4)


def legs(method: str, setup: Setup, track: float = 1.0) -> tuple[Leg, ...]:
    """Return the legs of a method. Only those after "round" depend on the track ratio."""
    return _tape(setup, track) if method == "tape" else _sensor(setup, tape=method == "gyro")


def _place(setup: Setup) -> str:
    return (
        f"On a free floor of {FLOOR_M:g} m x {FLOOR_M:g} m, place the robot with its middle "
        f"{setup.from_edge:.2f} m from the edge behind it, and {FLOOR_M / 2:g} m from the edges to "
        "its left and right."
    )


def _sensor(setup: Setup, *, tape: bool) -> tuple[Leg, ...]:
    optional = replace(
        FROM_MARK, words=f"{FROM_MARK.words} If you did not measure it, press only Enter",
        usual=0.0,
    )  # fmt: skip
    back = setup.ahead(FLOOR_M / 2 - setup.from_edge - setup.length)
    moves = [PAUSE, back, PAUSE]
    metres = min(CURVE_M, FLOOR_M / 2 - setup.from_edge)
    for rate, curve in MOVES:
        moves += [
            setup.spin(math.copysign(TURN_RAD, rate), abs(rate)),
            setup.arc(curve, metres), setup.arc(-curve, -metres),
        ]  # fmt: skip
    return (
        Leg(
            "straight",
            f"{_place(setup)} Mark on the floor where one wheel stands. {STAY}It stands, then "
            f"drives {setup.length:.2f} m straight ahead.",
            (PAUSE, setup.ahead(setup.length), PAUSE), (optional,) if tape else (),
        ),
        Leg(
            "turns",
            "The robot drives back to the middle of the floor. Then it repeatedly turns in place, "
            "and drives a curve there and back.",
            (*moves, PAUSE),
        ),
    )  # fmt: skip


def _tape(setup: Setup, track: float) -> tuple[Leg, ...]:
    longest = setup.spin(2 * math.pi * 1.1 * MAX_TRACK, ROUND_RATE)
    back = setup.ahead(FLOOR_M / 2 - setup.from_edge - setup.length)

    def spun(name: str, side: int, rate: RadPerS) -> Leg:
        once = setup.spin(side * 2 * math.pi, rate, track)
        count = max(1, min(3, int(MAX_SPIN_S / once.seconds)))
        return Leg(
            name,
            f"The robot turns {many(count, 'full circle')} {'left' if side > 0 else 'right'}.",
            (replace(once, seconds=count * once.seconds),), TO_LINE, side * 2 * math.pi * count,
        )  # fmt: skip

    return (
        Leg(
            "ahead",
            f"{_place(setup)} Draw or find a straight line on the floor, about 300 mm to the left "
            "of the robot, along which the robot faces: its front and its rear point have the "
            "same distance from the line, to the millimetre. Mark where one wheel stands. "
            f"{STAY}The robot drives {setup.length:.2f} m straight ahead.",
            (setup.ahead(setup.length),), (FROM_MARK, *TO_LINE),
        ),
        Leg(
            "round",
            "The robot drives back to the middle of the floor, and then turns left in place. Press "
            "SPACE when it has turned one full circle and faces along the line as before; an error "
            "of 20 deg does not matter.",
            (back, PAUSE, longest), TO_LINE, 2 * math.pi, by_key=True,
        ),
        spun("slowly", -1, TAPE_RATES[0]), spun("fast", 1, TAPE_RATES[1]),
    )  # fmt: skip
