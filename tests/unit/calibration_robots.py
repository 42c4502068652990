"""Simulated skid-steer robots and their logs. This module uses none of the code under test.

It does not use the simulator either: the calibration is judged by a robot that skids, slips and
counts by other equations than those from which it computes the settings.

It integrates the true motion in steps of 5 ms. The wheels report their mean speed of each period at
100 Hz in two decimals. The gyro has its own rate, a delay, a bias and noise. Positions come at 5
Hz.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

RADIUS, SEPARATION = 0.05, 0.30
STEP = 0.005

Plan = list[tuple[float, float, float]]
"""Commanded wheel motion as (seconds, m/s, rad/s), valid for a robot that does not skid."""

GUIDED: Plan = [
    (3, 0, 0), (6, 0.4, 0), (1, 0, 0), (8, 0, 1.5), (1, 0, 0), (8, 0, -1.5), (1, 0, 0),
    (6, -0.4, 0), (6, 0.3, 0.8), (6, 0.3, -0.8), (8, 0, 0.8), (8, 0, -0.8), (6, 0.4, 0),
    (6, 0.4, 0.4), (6, 0.4, -0.4), (3, 0, 0),
]  # fmt: skip
"""The drive that the guide would ask a person for; it lasts 83 s."""


def slow_square(turn: float) -> Plan:
    """Return a square of 1 m at 0.1 m/s with turns on the spot at `turn` rad/s. It lasts 74 s."""
    corner = (np.pi / 2 / abs(turn), 0.0, turn)
    edge: Plan = [(10.0, 0.1, 0.0), (1.0, 0.0, 0.0), corner, (1.0, 0.0, 0.0)]
    return [(3.0, 0.0, 0.0), *edge * 4, (2.0, 0.0, 0.0)]


def wander(rng: np.random.Generator, seconds: float) -> Plan:
    """Return a random drive with stops."""
    plan: Plan = [(2.0, 0.0, 0.0)]
    while sum(part[0] for part in plan) < seconds:
        lasts = float(rng.uniform(1.0, 4.0))
        v, w = float(rng.uniform(-0.3, 0.6)), float(rng.uniform(-1.6, 1.6))
        plan.append((lasts, v, w) if rng.random() > 0.15 else (1.5, 0.0, 0.0))
    return plan


@dataclass
class Robot:
    """The true properties of one robot and its sensors."""

    chi: float = 1.6
    """Effective track divided by wheel separation, when the robot turns slowly."""
    rate: float = 0.08
    """Growth of `chi` for each rad/s."""
    left: float = 0.998
    right: float = 1.002
    bias: float = 0.01
    gyro_noise: float = 0.01
    gyro_hz: float = 100.0
    late: float = 0.02
    place_noise: float = 0.01
    place_hz: float = 5.0
    outliers: float = 0.02
    lever: complex = 0.05 + 0.02j
    slip: float = 0.01
    """Standard deviation of the share of motion that each side loses to slip.

    The share varies over about a second.
    """
    wheel_noise: float = 0.0
    """Standard deviation of the error of a moving wheel's speed, rad/s.

    The error varies over about a second.
    """
    decimals: int = 2
    counts: int = 0
    """Encoder counts of a wheel turn; 0 for an encoder without steps."""
    period_noise: float = 0.0
    """Standard deviation of the times at which the board samples its wheels, s.

    The board divides by the true period, and the host multiplies by the mean one.
    """
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))


@dataclass
class Drive:
    """A log and the true motion at the wheels' sample times."""

    t: Floats
    left: Floats
    right: Floats
    gyro_t: Floats
    gyro: Floats
    place_t: Floats
    place: npt.NDArray[np.complex128]
    yaw: Floats
    """True heading at the wheels' times, rad."""
    where: npt.NDArray[np.complex128]

    def csv(self, *, gyro: bool = True, places: bool = True, run: str = "") -> str:
        """Return the log as CSV, with one row per sensor sample in order of time."""
        rows = [(t, f"{t:.6f},{a:.2f},{b:.2f},,,") for t, a, b in
                zip(self.t, self.left, self.right, strict=True)]  # fmt: skip
        if gyro:
            pairs = zip(self.gyro_t, self.gyro, strict=True)
            rows += [(t, f"{t:.6f},,,{w:.6f},,") for t, w in pairs]
        if places:
            spots = zip(self.place_t, self.place, strict=True)
            rows += [(t, f"{t:.6f},,,,{p.real:.4f},{p.imag:.4f}") for t, p in spots]
        rows.sort()
        return "t,left,right,yaw_rate,x,y,run\n" + "\n".join(f"{r},{run}" for _, r in rows) + "\n"


def drive(robot: Robot, plan: Plan, start: float = 0.0) -> Drive:
    """Return the log and the truth of a robot that drives this plan."""
    rng = robot.rng
    v, w = _smooth(plan)
    count = len(v)
    left = (v - w * SEPARATION / 2) / RADIUS
    right = (v + w * SEPARATION / 2) / RADIUS
    slips = [_slow_noise(rng, count, robot.slip) for _ in range(2)]
    fast = RADIUS * robot.left * left * (1 - slips[0])
    quick = RADIUS * robot.right * right * (1 - slips[1])
    turn = (quick - fast) / (SEPARATION * robot.chi)
    for _ in range(5):
        turn = (quick - fast) / (SEPARATION * robot.chi * (1 + robot.rate * np.abs(turn)))
    yaw = np.concatenate(([0.0], np.cumsum(turn) * STEP))
    ahead = np.exp(1j * (yaw[:-1] + turn * STEP / 2))
    where = np.concatenate(([0.0 + 0.0j], np.cumsum((fast + quick) / 2 * ahead) * STEP))
    times: Floats = np.asarray(np.arange(count + 1) * STEP, dtype=np.float64)
    if robot.wheel_noise:
        moves = (left != 0.0) | (right != 0.0)
        left = left + moves * _slow_noise(rng, count, robot.wheel_noise)
        right = right + moves * _slow_noise(rng, count, robot.wheel_noise)
    every = 2
    ends = np.arange(every, count + 1, every)
    if robot.counts or robot.period_noise:
        late = rng.normal(0.0, robot.period_noise, len(ends))
        samples: Floats = np.append(0.0, times[ends] + late)
        sides = [_counted(robot, times, np.asarray(side), samples) for side in (left, right)]
    else:
        sides = [
            side[: len(ends) * every].reshape(-1, every).mean(axis=1) for side in (left, right)
        ]
    shown_left, shown_right = (np.round(side, robot.decimals) for side in sides)
    gyro_t = np.arange(0.003, times[-1], 1 / robot.gyro_hz)
    gyro = np.interp(gyro_t - robot.late, times[:-1] + STEP / 2, turn) + robot.bias
    gyro += rng.normal(0.0, robot.gyro_noise, len(gyro_t))
    place_t = np.arange(0.1, times[-1], 1 / robot.place_hz)
    sensor = where + robot.lever * np.exp(1j * yaw)
    place = np.interp(place_t - robot.late, times, sensor)
    place += rng.normal(0, robot.place_noise, (len(place_t), 2)) @ np.array([1, 1j])
    wild = rng.random(len(place_t)) < robot.outliers
    place[wild] += rng.normal(0, 2.0, (int(wild.sum()), 2)) @ np.array([1, 1j])
    place = 12.0 - 7.0j + place * np.exp(0.7j)
    return Drive(
        np.asarray(times[ends] - every * STEP / 2 + start), shown_left, shown_right,
        gyro_t + start, gyro, place_t + start, place, yaw[ends], where[ends],
    )  # fmt: skip


def _counted(robot: Robot, times: Floats, speeds: Floats, samples: Floats) -> Floats:
    """Return the mean speed of a side between samples, computed from whole encoder counts."""
    angle = np.interp(samples, times, np.append(0.0, np.cumsum(speeds) * STEP))
    if robot.counts:
        step = 2 * np.pi / robot.counts
        phases = robot.rng.uniform(0.0, step, (2, 1))
        angle = (np.floor((angle + phases) / step) * step).mean(axis=0)
    return np.asarray(np.diff(angle) / np.diff(samples))


def _smooth(plan: Plan) -> tuple[Floats, Floats]:
    """Return the speeds of the plan with ramps of 0.3 s."""
    v = np.concatenate([np.full(round(s / STEP), v) for s, v, _ in plan])
    w = np.concatenate([np.full(round(s / STEP), w) for s, _, w in plan])
    kernel = np.full(60, 1 / 60)
    return np.convolve(v, kernel)[: len(v)], np.convolve(w, kernel)[: len(w)]


def _slow_noise(rng: np.random.Generator, count: int, deviation: float) -> Floats:
    knots = np.arange(0, count * STEP + 2, 1.0)
    values = np.interp(np.arange(count) * STEP, knots, rng.normal(0, deviation, len(knots)))
    return np.asarray(values)
