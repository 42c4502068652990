"""Writes the motion of a replayed robot as CSV; the columns for `acsard calibrate` come first.

Each feedback line and each gyro sample has a line of its own. The position by the robot's own
odometry has column names that calibration does not take for a measurement, because wheels cannot be
compared with themselves.
"""

from __future__ import annotations

from collections.abc import Iterator

from acsard.core.values import NS_PER_S, Estimate, GyroSample, Instant, Outputs
from acsard.recording.recorded_steps import Step

MEASURED = ("t [s]", "fr [rad/s]", "fl [rad/s]", "rl [rad/s]", "rr [rad/s]", "yaw_rate [rad/s]")
"""Columns that calibration reads: `t` is in s since 1970, `yaw_rate` comes from a gyro."""

TOLD = (
    "odom_x [m]", "odom_y [m]", "odom_yaw [rad]", "linear [m/s]", "angular [rad/s]",
    "applied_linear [m/s]", "applied_angular [rad/s]", "mode", "link", "source",
)  # fmt: skip

HEADER = ",".join([*MEASURED, *TOLD])
MEASURED_HEADER = ",".join(MEASURED)

_NO_WHEELS = "," * 4
_NOTHING_TOLD = "," * len(TOLD)


def rows(step: Step, outputs: Outputs) -> Iterator[str]:
    """Yield the CSV lines of a step, without line ends."""
    now = step.inputs.now
    for sample in step.inputs.gyro:
        yield turned(sample, now) + _NOTHING_TOLD
    if outputs.estimates:
        applied = outputs.applied
        went = f"{applied.linear:.6g},{applied.angular:.6g}"
        who = f"{outputs.mode},{outputs.link},{outputs.source}"
        for estimate in outputs.estimates:
            pose, twist = estimate.pose, estimate.twist
            where = f"{pose.x:.6f},{pose.y:.6f},{pose.yaw:.6f}"
            moves = f"{twist.linear:.6g},{twist.angular:.6g}"
            yield f"{rolled(estimate)},{where},{moves},{went},{who}"


def measured(step: Step, outputs: Outputs) -> Iterator[str]:
    """Yield the CSV lines of a step with only the columns that calibration reads."""
    for sample in step.inputs.gyro:
        yield turned(sample, step.inputs.now)
    for estimate in outputs.estimates:
        yield rolled(estimate)


def rolled(estimate: Estimate) -> str:
    """Return the measured columns of a feedback line."""
    wheels = ",".join(f"{speed:.6g}" for speed in estimate.speeds.as_tuple())
    return f"{_seconds(estimate.at.wall_ns)},{wheels},"


def turned(sample: GyroSample, now: Instant) -> str:
    """Return the measured columns of a gyro sample, at its stamp or else at its arrival."""
    arrived_ns = sample.at_ns + now.wall_ns - now.mono_ns
    at_ns = arrived_ns if sample.stamp_ns is None else sample.stamp_ns
    return f"{_seconds(at_ns)},{_NO_WHEELS}{sample.rate:.6g}"


def _seconds(wall_ns: int) -> str:
    return f"{wall_ns // NS_PER_S}.{wall_ns % NS_PER_S // 1000:06d}"
