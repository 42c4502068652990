"""Simulated drives and true end poses of robots whose errors have the declared statistics.

The tests compute NEES from them. This module implements only the declared error model
(`acsard.toml`, the docstring of `core/motion/error_model.py`) in numpy, for many robots at once. It
shares no code with the module that it tests, nor with the simulator: it moves a thousand robots in
one step. The encoders report exactly the commanded speeds. The ground and the robot's true size
change the actual motion.

NEES is e' P^-1 e, with e = log(estimate^-1 truth) and P the published covariance rotated by -yaw.
If P is right, the mean of NEES over many runs is 3, and 95 % of its values are below 7.815.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from acsard.core.config.settings import OdometryConfig, WheelMap
from acsard.core.link.feedback import Line
from acsard.core.values import Instant, WheelSpeeds
from tests.unit.odometer import Odometer
from tests.wheels import FOUR

Array = NDArray[np.float64]

RADIUS, TRACK, PERIOD = 0.05, 0.30, 0.01
AT = Instant(0, 0)
REGION = 7.815
"""The 95 % quantile of chi-squared with three degrees of freedom."""


class Model(Struct, frozen=True):
    """Noise and parameter errors, as in `[odometry]`."""

    distance: float
    yaw: float
    skid: float
    ratio_std: float = 0.0
    track_std: float = 0.0
    scale_std: float = 0.0

    def config(self) -> OdometryConfig:
        return OdometryConfig(
            distance_variance_per_metre=self.distance,
            yaw_variance_per_metre=self.yaw,
            yaw_variance_per_radian=self.skid,
            wheel_radius_ratio_std=self.ratio_std,
            wheel_separation_multiplier_std=self.track_std,
            distance_scale_std=self.scale_std,
        )


K = 1e-5
WHEELS = Model(K / 2, 2 * K / TRACK**2, 0.0)
"""A model with only the wheel noise of each side, k = 1e-5."""
DEFAULT = Model(1e-4, 1e-4, 1e-2)

Legs = list[tuple[float, float, float]]
"""Parts of a drive as (m/s, rad/s, s)."""


def circle(_: np.random.Generator) -> Legs:
    return [(0.5, 0.5, 63.0)]


def square(_: np.random.Generator) -> Legs:
    side = [(0.8, 0.0, 5.0), (0.0, 0.0, 0.8), (0.0, 1.2, math.pi / 2.4), (0.0, 0.0, 0.3)]
    return side * 12


def straight(_: np.random.Generator) -> Legs:
    return [(1.0, 0.0, 60.5), (0.0, 0.0, 1.0)]


def random(rng: np.random.Generator, seconds: float = 90.0) -> Legs:
    legs: Legs = []
    while sum(leg[2] for leg in legs) < seconds:
        stop, time = rng.random() < 0.15, rng.uniform(0.5, 4.0)
        legs.append((0.0 if stop else rng.uniform(-0.3, 1.0),
                     0.0 if stop else rng.uniform(-1.5, 1.5), time))  # fmt: skip
    return legs


Heard = Callable[[Array, np.random.Generator], list[Line]]
"""Returns the feedback lines that arrive from a drive."""

Scenario = Callable[[np.random.Generator], Legs]
SCENARIOS: dict[str, Scenario] = {
    "circle": circle,
    "square": square,
    "random": random,
    "straight": straight,
}


def reports(legs: Legs) -> Array:
    """Return both sides' speeds in every line, in two decimals, shape (lines, 2).

    The drive accelerates at 1 m/s2 and 4 rad/s2.
    """
    v = w = 0.0
    rows = []
    for linear, angular, seconds in legs:
        for _ in range(round(seconds / PERIOD)):
            v += max(-PERIOD, min(PERIOD, linear - v))
            w += max(-4 * PERIOD, min(4 * PERIOD, angular - w))
            rows.append(((v - w * TRACK / 2) / RADIUS, (v + w * TRACK / 2) / RADIUS))
    return np.round(np.array(rows), 2)


def true_ends(drives: list[Array], robots: int, model: Model, rng: np.random.Generator) -> Array:
    """Return x, y and yaw at the end of each drive, shape (3, drives, robots)."""
    shape = (len(drives), robots)
    steps = np.zeros((max(map(len, drives)), len(drives), 2))
    for i, drive in enumerate(drives):
        steps[: len(drive), i] = drive * RADIUS * PERIOD
    k = min(2 * model.distance, model.yaw * TRACK**2 / 2)
    along, yaw = model.distance - k / 2, model.yaw - 2 * k / TRACK**2
    ratio = model.ratio_std * rng.standard_normal(shape)
    left_off, right_off = 1 - ratio / 2, 1 + ratio / 2
    track = TRACK * (1 + model.track_std * rng.standard_normal(shape))
    scale = 1 + model.scale_std * rng.standard_normal(shape)
    # the same uncertainty as the default at the start
    pose = 1e-3 * rng.standard_normal((3, *shape))
    for step in steps:
        left, right = step[:, :1], step[:, 1:]
        if not step.any():
            continue
        noise = rng.standard_normal((4, *shape))
        dl = left * left_off + np.sqrt(k * abs(left)) * noise[0]
        dr = right * right_off + np.sqrt(k * abs(right)) * noise[1]
        path, turned = abs(left + right) / 2, abs(right - left) / TRACK
        d = (dl + dr) / 2 * scale + np.sqrt(along * path) * noise[2]
        turn = (dr - dl) / track + np.sqrt(yaw * path + model.skid * turned) * noise[3]
        chord, heading = d * np.sinc(turn / math.tau), pose[2] + turn / 2
        pose += chord * np.cos(heading), chord * np.sin(heading), turn
    return pose


def fold(
    lines: Iterable[Line], model: Model, counts: int = 0, wheels: WheelMap = FOUR
) -> tuple[Array, Array]:
    """Return the final pose and covariance of odometry."""
    robot = Odometer(model.config(), counts, wheels=wheels)
    for line in lines:
        estimate = robot.fold(line)
    pose, p = estimate.pose, estimate.covariance
    covariance = [[p.xx, p.xy, p.xyaw], [p.xy, p.yy, p.yyaw], [p.xyaw, p.yyaw, p.yawyaw]]
    return np.array([pose.x, pose.y, pose.yaw]), np.array(covariance)


def plain(drive: Array) -> list[Line]:
    """Return the speeds of a drive as feedback lines."""
    return [Line(AT, WheelSpeeds(r, le, le, r), PERIOD) for le, r in drive.tolist()]


def errors(pose: Array, ends: Array) -> Array:
    """Return log(estimate^-1 truth), shape (3, robots)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = ends[0] - pose[0], ends[1] - pose[1]
    yaw = np.remainder(ends[2] - pose[2] + math.pi, math.tau) - math.pi
    x, y, half = c * dx + s * dy, c * dy - s * dx, yaw / 2
    a = np.where(abs(half) < 1e-9, 1.0, half / np.tan(np.where(half == 0.0, 1.0, half)))
    return np.stack([a * x + half * y, a * y - half * x, yaw])


def nees(pose: Array, covariance: Array, ends: Array) -> Array:
    """Return the NEES of each robot that truly ended at `ends`."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    e = errors(pose, ends)
    return np.asarray((e * np.linalg.solve(turned @ covariance @ turned.T, e)).sum(0))


def study(
    scenario: Scenario,
    model: Model,
    runs: int = 1000,
    drives: int = 1,
    seed: int = 1,
    heard: Heard | None = None,
    counts: int = 0,
    wheels: WheelMap = FOUR,
) -> Array:
    """Return the NEES of `runs` robots, spread over `drives` drives.

    Odometry receives every line. If `heard` is given, odometry receives the lines that it returns.
    """
    rng = np.random.default_rng(seed)
    paths = [reports(scenario(rng)) for _ in range(drives)]
    ends = true_ends(paths, runs // drives, model, rng)
    lines = [heard(path, rng) if heard else plain(path) for path in paths]
    results = [fold(entry, model, counts, wheels) for entry in lines]
    return np.concatenate([nees(*entry, ends[:, i]) for i, entry in enumerate(results)])
