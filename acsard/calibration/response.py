"""Finds how soon the wheels follow their commands: `feedback.response_time`.

The daemon compares each wheel with its command behind a lag of this time (`core/motion/wheels.py`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from acsard.calibration.log import Run
from acsard.calibration.series import Floats, Mask
from acsard.core.config.settings import DriveConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import Seconds, Twist

TIMES_S = np.geomspace(0.01, 5.0, 60)  # the range of the setting
STEP_S, MIN_STEPS, MAX_STEPS = 0.02, 200, 30_000
COMMAND_AGE_S = 0.5  # above it, the command of a sample is unknown
MAX_UNEXPLAINED = 0.5  # share of the squared speeds


def response_time(runs: Sequence[Run], drive: DriveConfig) -> Seconds | None:
    """Return the response time that fits the wheels best, or None if the log does not show it."""
    kinematics = Kinematics(drive)
    ahead, left = (kinematics.wheel_speeds(Twist(*v)) for v in ((1.0, 0.0), (0.0, 1.0)))
    mix = np.array([[ahead.front_left, ahead.front_right], [left.front_left, left.front_right]])
    squares, whole, steps = np.zeros(len(TIMES_S)), 0.0, 0
    for run in runs:
        if len(run.commands_t) < 2 or steps > MAX_STEPS:
            continue
        t = np.arange(max(run.t[0], run.commands_t[0]), run.t[-1], STEP_S)
        at = np.searchsorted(run.commands_t, t, side="right") - 1
        angles = np.column_stack([np.interp(t, run.t, side) for side in (run.left, run.right)])
        actual = np.diff(angles, axis=0) / STEP_S
        if len(actual) < 2:
            continue
        # A wheel cannot follow a command beyond its highest speed.
        fastest = np.abs(actual).max(axis=0)
        wanted = np.clip(run.commands[at[1:]] @ mix, -fastest, fastest)
        known = t[1:] - run.commands_t[at[1:]] < COMMAND_AGE_S
        off = _expected(wanted, actual, known) - actual[:, :, None]
        squares += (off**2).sum(axis=(0, 1))
        whole += float((actual**2).sum())
        steps += len(actual)
    best = int(np.argmin(squares))
    if steps < MIN_STEPS or not squares[best] < MAX_UNEXPLAINED * whole:
        return None
    return float(TIMES_S[best])


def _expected(wanted: Floats, actual: Floats, known: Mask) -> Floats:
    # The speed y of a healthy wheel follows the command u with the response time T: T dy/dt = u - y
    share = STEP_S / (TIMES_S + STEP_S)
    speeds = np.empty((*wanted.shape, len(TIMES_S)))
    last = np.repeat(actual[0, :, None], len(TIMES_S), axis=1)
    for n in range(len(wanted)):
        if known[n]:
            last = last + (wanted[n, :, None] - last) * share
        else:
            last = np.repeat(actual[n, :, None], len(TIMES_S), axis=1)
        speeds[n] = last
    return speeds
