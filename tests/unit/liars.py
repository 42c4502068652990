"""Simulated drives of four encoders, of which one may fail, for the tests of `wheels.py`.

Each wheel has its own motor lag, tyre and load, and starts at a random position within one count. A
line reports counts divided by its period in two decimals. These drives test the module
`core/motion/wheels.py`, so this module uses only numpy and shares no code with it. The seed
determines everything that a robot does.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from acsard.core.codes import Reason
from acsard.core.config.settings import DriveConfig
from acsard.core.link.feedback import Feedback
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import Estimate, Instant, Pose, WheelSpeeds
from tests.unit.odometer import Odometer, arc

Array = NDArray[np.float64]

PERIOD, RADIUS, TRACK = 0.01, 0.05, 0.30
AT = Instant(0, 0)
SIDES = (1, -1, -1, 1)
"""Direction of each wheel in a left turn, in `WHEELS` order."""


class Robot(Struct, frozen=True):
    """How the wheels of one robot differ.

    `lag` is the mean motor lag, s. `lags` and `tyres` are standard deviations, relative to the lag
    and to the rolled distance.
    """

    counts: int = 3200
    lag: float = 0.05
    lags: float = 0.1
    tyres: float = 0.015
    load: float = 0.0
    """Largest share of its speed that a wheel loses in a turn of 1 rad/s."""


def commands(rng: np.random.Generator, seconds: float, stops: float = 0.15) -> Array:
    """Return commanded wheel speeds of a random drive, rad/s, shape (lines, 4).

    The drive stays within the limits.
    """
    v = w = 0.0
    rows: list[list[float]] = []
    while len(rows) * PERIOD < seconds:
        stop = rng.random() < stops
        linear = 0.0 if stop else rng.uniform(-0.6, 1.0)
        angular = 0.0 if stop else rng.uniform(-2.0, 2.0)
        for _ in range(round(rng.uniform(0.5, 4.0) / PERIOD)):
            v += max(-PERIOD, min(PERIOD, linear - v))
            w += max(-4 * PERIOD, min(4 * PERIOD, angular - w))
            rows.append([(v + side * w * TRACK / 2) / RADIUS for side in SIDES])
    return np.round(np.array(rows[: round(seconds / PERIOD)]), 2)


def rolled(speeds: Array, robot: Robot, rng: np.random.Generator) -> Array:
    """Return the angle that each wheel has turned since the start, rad, shape (lines, 4)."""
    lag = robot.lag * (1 + robot.lags * rng.standard_normal(4))
    size = 1 + robot.tyres * rng.standard_normal(4)
    rest = np.exp(-PERIOD / lag)
    turning = abs(speeds[:, 0] - speeds[:, 1]) * RADIUS / TRACK
    loaded = 1 - robot.load * rng.uniform(0, 1, 4) * np.minimum(turning, 1.0)[:, None]
    speed = np.zeros(4)
    angles = np.empty_like(speeds)
    angle = rng.uniform(0, 1, 4)
    for i, goal in enumerate(speeds * size * loaded):
        error = speed - goal
        angle = angle + goal * PERIOD + error * lag * (1 - rest)
        speed = goal + error * rest
        angles[i] = angle
    return angles


def reported_speeds(angles: Array, counts: int) -> Array:
    """Return the speeds that encoders with this many counts report, rad/s, shape (lines, 4)."""
    count = math.tau / counts
    whole = np.floor(angles / count)
    steps = np.diff(whole, axis=0, prepend=whole[:1])
    return np.round(steps * count / PERIOD, 2)


Lie = Callable[[Array, int, int], Array]
"""Maps (reported speeds, wheel, first false line) to the reported speeds with the failure."""


def dead(speeds: Array, wheel: int, begun: int) -> Array:
    lying = speeds.copy()
    lying[begun:, wheel] = 0.0
    return lying


def reversed_(speeds: Array, wheel: int, begun: int) -> Array:
    lying = speeds.copy()
    lying[begun:, wheel] *= -1.0
    return lying


def stuck(speeds: Array, wheel: int, begun: int) -> Array:
    lying = speeds.copy()
    lying[begun:, wheel] = lying[begun - 1, wheel]
    return lying


LIES: dict[str, Lie] = {"dead": dead, "reversed": reversed_, "stuck": stuck}


def lines(speeds: Array, counts: int = 0) -> list[Feedback]:
    """Return feedback lines with the quantization step of encoders with this many counts.

    With 0 counts the lines have no known step.
    """
    step = math.tau / counts / PERIOD if counts else 0.0
    return [Feedback(AT, WheelSpeeds(*row), PERIOD, steps=(step,) * 4) for row in speeds.tolist()]


def wishes(speeds: Array) -> list[WheelSpeeds]:
    return [WheelSpeeds(*row) for row in speeds.tolist()]


def odometry(counts: int = 0) -> Odometer:
    return Odometer(counts=counts)


def fold(robot: Odometer, line: Feedback, commanded: WheelSpeeds) -> tuple[Estimate, Reason | None]:
    """Return the estimate after a line, and the wheel fault that it proves."""
    robot.checks.wheels.commanded = commanded
    estimate = robot.fold(line)
    return estimate, robot.checks.wheels.fault


def apart(a: Pose, b: Pose) -> tuple[float, float]:
    """Return the distance, m, and the heading difference, rad, between two poses."""
    return math.dist((a.x, a.y), (b.x, b.y)), abs(math.remainder(a.yaw - b.yaw, math.tau))


class Plain:
    """Odometry that integrates the mean of front and rear wheels and excludes no wheel."""

    def __init__(self) -> None:
        self._kinematics, self.pose, self._lost = Kinematics(DriveConfig()), Pose(), 0.0

    def skip(self, line: Feedback) -> None:
        self._lost += line.dt

    def fold(self, line: Feedback) -> None:
        dt, self._lost = self._lost + line.dt, 0.0
        turned = WheelSpeeds(*(speed * dt for speed in line.speeds.as_tuple()))
        twist = self._kinematics.twist(turned)
        self.pose = arc(self.pose, twist.linear, twist.angular)
