"""Estimates from a log how soon the wheels follow their commands, and how fast they can turn.

The daemon compares each wheel with its command behind a lag of `feedback.response_time`
(`core/motion/wheels.py`). This module finds the one that fits the wheels of the log best.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from msgspec import Struct

from acsard.calibration.log_table import Floats
from acsard.calibration.runs import GAP_S, Run
from acsard.core.config.settings import DriveConfig, FeedbackConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import RadPerS, Seconds, Twist

RESPONSE_TIMES_S = np.geomspace(0.01, 5.0, 60)  # the range of `feedback.response_time`

# Numbers of wheel samples.
LEAST_ROWS, MOST_ROWS = 200, 30_000

MAX_UNEXPLAINED = 0.5  # fraction of the sum of squared wheel speeds

# Limits that show that a wheel turns as fast as it can.
STEADY_S, REACHED, CONSTANT, MIN_SPEED = 1.0, 0.9, 0.03, 2.0  # s, fractions, rad/s

AGREEMENT_FACTOR = 1.5  # up to which the fitted and the configured response time agree


class Commanded(NamedTuple):
    """The wheel speeds of a run, with the commands that applied to them."""

    steps: Floats  # s before each sample of the wheel speeds
    wanted: Floats  # commanded speeds (left, right), rad/s, shape (samples, 2)
    actual: Floats  # measured speeds (left, right), rad/s, shape (samples, 2)


class WheelResponse(Struct, frozen=True):
    """The response of the wheels to their commands in a log."""

    seconds: Seconds  # response time that fits the log best
    present: Seconds  # configured
    fastest: RadPerS  # highest speed of the wheels; infinity if the log shows no such limit

    def settings(self) -> dict[str, float]:
        """Return the new values for settings of `[feedback]`; empty if none must change.

        A shorter one is not proposed: it would only leave less time for a bump.
        """
        if self.seconds <= AGREEMENT_FACTOR * self.present:
            return {}
        return {"response_time": float(f"{self.seconds:.2g}")}

    def sentences(self) -> list[str]:
        follow = f"the wheels follow their commands with a response time of {self.seconds:.2g} s"
        if self.settings():
            then = f"; the configured feedback.response_time = {self.present:g} s is too short"
        else:
            then = f", and feedback.response_time = {self.present:g} s is long enough"
        sentences = [follow + then]
        if np.isfinite(self.fastest):
            sentences.append(
                f"the wheels reach only {self.fastest:.3g} rad/s although commands were higher: "
                f"write limits.wheel_speed = {self.fastest:.3g}"
            )
        return sentences


def response(
    driven: Sequence[Run], drive: DriveConfig, feedback: FeedbackConfig
) -> WheelResponse | None:
    """Return the response of the wheels to their commands; None if the log does not show it."""
    parts: list[Commanded] = []
    room = MOST_ROWS
    for run in driven:
        if len(run.commands_t) > 1 and room:
            parts.append(Commanded(*(column[:room] for column in _commanded(run, drive))))
            room -= len(parts[-1].steps)
    if sum(len(part.steps) for part in parts) < LEAST_ROWS:
        return None
    fastest = _fastest(parts)
    squares, whole = np.zeros(len(RESPONSE_TIMES_S)), 0.0
    for part in parts:
        slower = part._replace(wanted=np.clip(part.wanted, -fastest, fastest))
        squares += ((_expected(slower) - part.actual[:, :, None]) ** 2).sum(axis=(0, 1))
        whole += float((part.actual**2).sum())
    best = int(np.argmin(squares))
    if not squares[best] < MAX_UNEXPLAINED * whole:
        return None
    return WheelResponse(float(RESPONSE_TIMES_S[best]), feedback.response_time, fastest)


def _commanded(run: Run, drive: DriveConfig) -> Commanded:
    kinematics = Kinematics(drive)
    ahead = kinematics.wheel_speeds(Twist(1.0, 0.0))
    turning = kinematics.wheel_speeds(Twist(0.0, 1.0))
    at = np.searchsorted(run.commands_t, run.t, side="right") - 1
    has_command = (at >= 0) & (run.t - run.commands_t[at] < GAP_S)
    steps = np.diff(run.t, prepend=np.nan)
    steps[~has_command | (steps > GAP_S)] = np.nan
    wanted = run.linear[at, None] * (ahead.front_left, ahead.front_right) + run.angular[
        at, None
    ] * (turning.front_left, turning.front_right)
    return Commanded(steps, np.asarray(wanted), np.column_stack((run.left, run.right)))


def _expected(part: Commanded) -> Floats:
    # The speed y of a healthy wheel follows the command u with the response time T:
    #
    #     T dy/dt = u - y
    steps, wanted, actual = part
    expected = np.empty((*wanted.shape, len(RESPONSE_TIMES_S)))
    last = np.zeros((2, len(RESPONSE_TIMES_S)))
    for number, step in enumerate(steps):
        if np.isnan(step):
            last = np.repeat(actual[number, :, None], len(RESPONSE_TIMES_S), axis=1)
        else:
            last = last + (wanted[number, :, None] - last) * (step / (RESPONSE_TIMES_S + step))
        expected[number] = last
    return expected


def _fastest(parts: Sequence[Commanded]) -> float:
    speeds: list[float] = []
    for steps, wanted, actual in parts:
        for command, speed in zip(wanted.T, np.abs(actual.T), strict=True):
            short = (speed > MIN_SPEED) & (speed < REACHED * np.abs(command)) & ~np.isnan(steps)
            edges = np.flatnonzero(np.diff(short.astype(np.int8), prepend=0, append=0))
            for begin, end in edges.reshape(-1, 2):
                at = np.cumsum(steps[begin:end])
                late, before = at > at[-1] - STEADY_S / 2, at > at[-1] - STEADY_S
                if at[-1] < 2 * STEADY_S or not (before & ~late).any():
                    continue
                last, first = (float(speed[begin:end][m].mean()) for m in (late, before & ~late))
                if abs(last - first) < CONSTANT * last:
                    speeds.append(last)
    return max(speeds, default=np.inf)
