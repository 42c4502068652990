"""Estimates from a log how soon the wheels follow their commands, and how fast they can turn.

The daemon reports a fault if a wheel contradicts the model of a healthy wheel for
`feedback.fault_time`. The model depends on `feedback.response_time`. This module finds the
response time that fits the wheels of the log best, and assumes that these wheels are healthy. It
also runs the daemon's own fault detection (`core/motion/wheel_witness.py`) on the log, with the
configured response time. The result shows whether the daemon would report a false fault.
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
from acsard.core.values import Twist

RESPONSE_TIMES_S = np.geomspace(0.01, 5.0, 60)
"""Response times that are tried, s. They cover the range of `feedback.response_time`."""

LEAST_ROWS, MOST_ROWS = 200, 30_000
"""Minimum and maximum number of wheel samples.

A log with fewer samples than `LEAST_ROWS` gives no response time. At most `MOST_ROWS` samples are
used, which is 5 minutes at 100 Hz.
"""

MAX_UNEXPLAINED = 0.5
"""Largest fraction of the sum of squared wheel speeds that the model may leave unexplained."""

MAX_FAULTY_FRACTION = 0.5
"""Longest time for which a healthy wheel may look faulty with the proposed response time.

The time is a fraction of `feedback.fault_time`.
"""

STEADY_S, REACHED, CONSTANT = 1.0, 0.9, 0.03
"""Limits that show that a wheel turns as fast as it can.

The speed of such a wheel stays below `REACHED` times its command for at least 2 * `STEADY_S` s. In
the last `STEADY_S` s, the speed changes by less than the fraction `CONSTANT`.
"""

AGREEMENT_FACTOR = 1.5
"""If the fitted and the configured response time differ by at most this factor, they agree."""


class Commanded(NamedTuple):
    """The wheel speeds of a run, with the commands that applied to them."""

    steps: Floats
    """Interval before each sample of the wheel speeds, s.

    It is NaN if no command applies to this sample, or if the interval is a gap.
    """
    wanted: Floats
    """Commanded speeds (left, right), rad/s, shape (samples, 2)."""
    actual: Floats
    """Measured speeds (left, right), rad/s, shape (samples, 2)."""


class WheelResponse(Struct, frozen=True):
    """The response of the wheels to their commands in a log."""

    seconds: float
    """Response time that fits the log best, s."""
    proposed: float | None
    """Response time to configure, s; None if the tool proposes no change.

    There is a proposal only if `false_fault` is true. The candidates are the times in
    `RESPONSE_TIMES_S`, rounded to two digits. The proposal is the smallest candidate, not below
    `seconds`, with which no wheel looks faulty for longer than `MAX_FAULTY_FRACTION` permits. If no
    candidate meets this condition, the value is None.
    """
    present: float
    """Configured response time, s."""
    false_fault: bool
    """Whether the daemon would report a fault in this log with the configured response time.

    Such a fault would be false, because the wheels are assumed to be healthy.
    """
    fastest: float
    """Highest speed that the wheels reach, rad/s; infinity if the log shows no such limit."""

    def settings(self) -> dict[str, float]:
        """Return the new values for settings of `[feedback]`, by the name of the setting.

        The dictionary is empty if no setting must change.
        """
        if not self.false_fault or self.proposed is None:
            return {}
        return {"response_time": self.proposed}

    def sentences(self) -> list[str]:
        """Return one or two sentences for the report.

        The first sentence is about the response time. If `fastest` is finite, a second sentence is
        about `limits.wheel_speed`.
        """
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
    """Return the response of the wheels to the commands in the runs `driven`.

    The result is None if the log has too few commands, or if the wheels do not follow them.
    """
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
    """Return the wheel speeds, rad/s, that each of `RESPONSE_TIMES_S` predicts.

    The shape is (samples, 2 sides, response times).
    """
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
    """Return the longest time for which a wheel contradicts the daemon's model of a wheel, s.

    If this time exceeds `fault_time`, the daemon would report a fault.
    """
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
    """Return the highest speed, rad/s, that a wheel keeps although its command is higher.

    Return infinity if the log shows no such speed.
    """
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
