"""Estimates from a log how soon the wheels follow their commands, and how fast they can turn.

The daemon reports a wheel fault if a wheel contradicts the model of a healthy wheel for
`feedback.fault_time`. This module finds the `feedback.response_time` that fits the healthy wheels
of the log best, and runs the daemon's own detection (`core/motion/wheel_witness.py`) on the log
with the configured one, which shows false faults.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from msgspec import Struct

from acsard.calibration.log_table import Floats
from acsard.calibration.runs import GAP_S, Run
from acsard.core.config.motion_rules import MIN_EVIDENCE_LINES
from acsard.core.config.settings import DriveConfig, FeedbackConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.wheel_faults import MIN_COMMANDED_SPEED
from acsard.core.motion.wheel_witness import MIN_FAULT_SPEED, Expected, Witness
from acsard.core.values import RadPerS, Seconds, Twist

RESPONSE_TIMES_S = np.geomspace(0.01, 5.0, 60)  # the range of `feedback.response_time`

# Numbers of wheel samples.
LEAST_ROWS, MOST_ROWS = 200, 30_000

MAX_UNEXPLAINED = 0.5  # fraction of the sum of squared wheel speeds

MAX_FAULTY_FRACTION = 0.5  # of a fault time, in which a healthy wheel may look faulty

# Limits that show that a wheel turns as fast as it can.
STEADY_S, REACHED, CONSTANT = 1.0, 0.9, 0.03

AGREEMENT_FACTOR = 1.5  # up to which the fitted and the configured response time agree


class Commanded(NamedTuple):
    """The wheel speeds of a run, with the commands that applied to them."""

    steps: Floats  # s before each sample of the wheel speeds
    wanted: Floats  # commanded speeds (left, right), rad/s, shape (samples, 2)
    actual: Floats  # measured speeds (left, right), rad/s, shape (samples, 2)


class WheelResponse(Struct, frozen=True):
    """The response of the wheels to their commands in a log."""

    seconds: Seconds  # response time that fits the log best
    proposed: Seconds | None  # to configure; None if the tool proposes no change
    present: Seconds  # configured
    false_fault: bool  # the daemon would report one in this log with the configured time
    fastest: RadPerS  # highest speed of the wheels; infinity if the log shows no such limit

    def settings(self) -> dict[str, float]:
        """Return the new values for settings of `[feedback]`; empty if none must change."""
        if not self.false_fault or self.proposed is None:
            return {}
        return {"response_time": self.proposed}

    def sentences(self) -> list[str]:
        follow = f"the wheels follow their commands with a response time of {self.seconds:.2g} s"
        if self.false_fault:
            then = (
                f", but with feedback.response_time = {self.present:g} the daemon would report a "
                "wheel fault: "
            )
            if self.proposed is not None:
                then += f"the new feedback.response_time is {self.proposed:g}"
            elif np.isfinite(self.fastest):
                then += "first lower limits.wheel_speed as the next note says"
            else:
                then += (
                    "raising feedback.response_time does not reliably prevent this; if the wheels "
                    "are healthy, raise feedback.fault_time"
                )
        elif max(self.seconds / self.present, self.present / self.seconds) > AGREEMENT_FACTOR:
            then = (
                f"; the configured feedback.response_time = {self.present:g} s differs, but causes "
                "no fault in this log"
            )
        else:
            then = f", which agrees with the configured feedback.response_time = {self.present:g} s"
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
    limit, proposed = feedback.fault_time, None
    false_fault = limit > 0.0 and _evidence(parts, feedback.response_time, limit) > limit
    if false_fault:
        rounded = (float(f"{t:.2g}") for t in RESPONSE_TIMES_S[best:])
        good = (
            t
            for t in rounded
            if t >= RESPONSE_TIMES_S[best]
            and _evidence(parts, t, limit) <= MAX_FAULTY_FRACTION * limit
        )
        proposed = next(good, None)
    return WheelResponse(
        float(RESPONSE_TIMES_S[best]), proposed, feedback.response_time, false_fault, fastest
    )


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


def _evidence(parts: Sequence[Commanded], response_time: float, fault_time: float) -> float:
    longest, most = 0.0, fault_time / MIN_EVIDENCE_LINES
    for steps, wanted, actual in parts:
        sides = [(Expected(), Witness()) for _ in range(2)]
        for step, commands, speeds in zip(
            steps.tolist(), wanted.tolist(), actual.tolist(), strict=True
        ):
            still = max(map(abs, commands)) < MIN_COMMANDED_SPEED
            for (expected, witness), command, speed in zip(sides, commands, speeds, strict=True):
                if math.isnan(step):
                    expected.forget()
                    witness.forget()
                    continue
                expected.follow(command, speed, speed, step, response_time)
                witness.check_speed(speed, expected, step, most, 0.0, still)
                longest = max(longest, *witness.evidence.values())
    return longest


def _fastest(parts: Sequence[Commanded]) -> float:
    speeds: list[float] = []
    for steps, wanted, actual in parts:
        for command, speed in zip(wanted.T, np.abs(actual.T), strict=True):
            short = (
                (speed > MIN_FAULT_SPEED) & (speed < REACHED * np.abs(command)) & ~np.isnan(steps)
            )
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
