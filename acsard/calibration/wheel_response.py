"""Finds how soon the wheels of a log follow their commands, and how fast they can turn.

The daemon expects of a wheel that its speed y follows the command u with the time constant
`feedback.response_time` (T below) and calls a wheel faulty that contradicts this for
`feedback.fault_time`:

    T dy/dt = u - y

The response time that fits best is found by trying. The present one is judged by the longest time
for which a sound wheel of this log contradicts it: it turns against the expected direction, or less
than a tenth as fast as expected.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from acsard.calibration.log_table import Floats
from acsard.calibration.runs import GAP_S, Run
from acsard.core.config.settings import DriveConfig, FeedbackConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import Twist

TRIED = np.geomspace(0.01, 5.0, 60)
"""Response times that are tried, s: the range of the setting."""

LEAST_ROWS, MOST_ROWS = 200, 30_000
"""Smallest number of wheel samples with a command, and number that is enough.

The latter is five minutes at 100 Hz. More would only take memory.
"""

FOLLOWS = 0.5
"""Largest part of the speeds, as squares, that the model may leave unexplained."""

TURNS = 2.0
"""Expected speed above which a wheel is judged, rad/s, as the daemon does."""

AGAINST, DEAD = 0.3, 0.1
"""Speeds, as fractions of the expected one, from which on a wheel turns against it, or is dead."""

SPARE = 0.5
"""Fraction of the fault time for which a sound wheel may contradict the proposed response time."""

STEADY_S, REACHED, CONSTANT = 1.0, 0.9, 0.03
"""Evidence for the highest speed of a wheel.

For twice `STEADY_S` s the wheel stays below `REACHED` of its command. In the last `STEADY_S` its
speed does not change by more than the fraction `CONSTANT`.
"""

SAME = 1.5
"""Ratio of response times up to which they count as equal."""


class WheelResponse(Struct, frozen=True):
    """How the wheels of a log follow their commands."""

    seconds: float
    """Response time that fits best, s."""
    proposed: float
    """Response time that causes no fault in this log, s."""
    present: float
    """Configured response time, s."""
    false_fault: bool
    """Whether the daemon would take the sound wheels of this log for faulty."""
    fastest: float
    """Highest speed that the wheels reach, rad/s; infinite if no command was higher."""

    def settings(self) -> dict[str, float]:
        """Return the settings of `[feedback]` that must change."""
        return {"response_time": self.proposed} if self.false_fault else {}

    def sentences(self) -> list[str]:
        """Return a sentence about the response time, and one about a speed that is a limit."""
        follow = f"the wheels follow their commands with a response time of {self.seconds:.2g} s"
        if self.false_fault:
            then = (
                f", and feedback.response_time = {self.present:g} would take them for faulty: "
                f"the new value is {self.proposed:g}"
            )
        elif max(self.seconds / self.present, self.present / self.seconds) > SAME:
            then = f". feedback.response_time is {self.present:g}, and causes no fault in this log"
        else:
            then = f", as feedback.response_time = {self.present:g} says"
        found = [follow + then]
        if np.isfinite(self.fastest):
            found.append(
                f"the wheels reach {self.fastest:.3g} rad/s, and commands were higher: write "
                f"limits.wheel_speed = {self.fastest:.3g}"
            )
        return found


def response(
    driven: Sequence[Run], drive: DriveConfig, feedback: FeedbackConfig
) -> WheelResponse | None:
    """Return how the wheels follow, or None if the log has no commands that they follow."""
    parts: list[tuple[Floats, Floats, Floats]] = []
    room = MOST_ROWS
    for run in driven:
        if len(run.commands_t) > 1 and room:
            steps, wanted, seen = _commanded(run, drive)
            parts.append((steps[:room], wanted[:room], seen[:room]))
            room -= len(parts[-1][0])
    if sum(len(steps) for steps, _, _ in parts) < LEAST_ROWS:
        return None
    fastest = _fastest(parts)
    squares, whole, longest = np.zeros(len(TRIED)), 0.0, np.zeros(len(TRIED))
    lasted_now = 0.0
    now = np.array([feedback.response_time])
    for steps, wanted, seen in parts:
        expected = _expected(steps, np.clip(wanted, -fastest, fastest), seen, TRIED)
        squares += ((expected - seen[:, :, None]) ** 2).sum(axis=(0, 1))
        whole += float((seen**2).sum())
        longest = np.maximum(longest, _contradicted(steps, wanted, seen, TRIED))
        lasted_now = max(lasted_now, float(_contradicted(steps, wanted, seen, now)[0]))
    best = int(np.argmin(squares))
    if not squares[best] < FOLLOWS * whole:
        return None
    limit = feedback.fault_time
    good = np.flatnonzero((longest <= SPARE * limit) & (TRIED[best] <= TRIED))
    proposed = float(TRIED[good[0] if len(good) else best])
    false_fault = bool(limit) and lasted_now > limit and bool(len(good))
    return WheelResponse(
        float(TRIED[best]), float(f"{proposed:.2g}"), feedback.response_time, false_fault, fastest
    )


def _commanded(run: Run, drive: DriveConfig) -> tuple[Floats, Floats, Floats]:
    """Return the steps (s), the commanded and the measured speeds of both sides, rad/s.

    A step of NaN has no command, or follows a gap. The speeds have the shape (samples, 2).
    """
    kinematics = Kinematics(drive)
    ahead = kinematics.wheel_speeds(Twist(1.0, 0.0))
    turning = kinematics.wheel_speeds(Twist(0.0, 1.0))
    at = np.searchsorted(run.commands_t, run.t, side="right") - 1
    told = (at >= 0) & (run.t - run.commands_t[at] < GAP_S)
    steps = np.diff(run.t, prepend=np.nan)
    steps[~told | (steps > GAP_S)] = np.nan
    wanted = run.linear[at, None] * (ahead.front_left, ahead.front_right) + run.angular[
        at, None
    ] * (turning.front_left, turning.front_right)
    return steps, np.asarray(wanted), np.column_stack((run.left, run.right))


def _expected(steps: Floats, wanted: Floats, seen: Floats, times: Floats) -> Floats:
    """Return the expected speeds for each response time, shape (samples, 2, times)."""
    expected = np.empty((*wanted.shape, len(times)))
    last = np.zeros((2, len(times)))
    for number, step in enumerate(steps):
        if np.isnan(step):
            last = np.repeat(seen[number, :, None], len(times), axis=1)
        else:
            last = last + (wanted[number, :, None] - last) * (step / (times + step))
        expected[number] = last
    return expected


def _contradicted(steps: Floats, wanted: Floats, seen: Floats, times: Floats) -> Floats:
    """Return the longest time for which a wheel contradicts each response time, s."""
    expected = _expected(steps, wanted, seen, times)
    told, speed = wanted[..., None], seen[..., None]
    size, turns = np.abs(expected), np.abs(speed)
    least = np.minimum(size, np.abs(told))
    moving = (size > TURNS) & (expected * told > 0.0)
    bad = moving & (
        ((speed * expected < 0.0) & (turns > AGAINST * size))
        | ((least > TURNS) & (turns < DEAD * least))
    )
    bad &= ~np.isnan(steps)[:, None, None]
    lasted, longest = np.zeros(bad.shape[1:]), np.zeros(bad.shape[1:])
    for step, row in zip(np.nan_to_num(steps), bad, strict=True):
        lasted = np.where(row, lasted + step, 0.0)
        longest = np.maximum(longest, lasted)
    return np.asarray(longest.max(axis=0))


def _fastest(parts: Sequence[tuple[Floats, Floats, Floats]]) -> float:
    """Return the speed at which wheels stay though their commands are higher, rad/s, or inf."""
    found: list[float] = []
    for steps, wanted, seen in parts:
        for told, speed in zip(wanted.T, np.abs(seen.T), strict=True):
            short = (speed > TURNS) & (speed < REACHED * np.abs(told)) & ~np.isnan(steps)
            edges = np.flatnonzero(np.diff(short.astype(np.int8), prepend=0, append=0))
            for begin, end in edges.reshape(-1, 2):
                at = np.cumsum(steps[begin:end])
                late, before = at > at[-1] - STEADY_S / 2, at > at[-1] - STEADY_S
                if at[-1] < 2 * STEADY_S or not (before & ~late).any():
                    continue
                last, first = (float(speed[begin:end][m].mean()) for m in (late, before & ~late))
                if abs(last - first) < CONSTANT * last:
                    found.append(last)
    return max(found, default=np.inf)
