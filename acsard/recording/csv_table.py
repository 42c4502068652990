"""Writes the motion of a replayed robot as CSV. The columns for `acsard calibrate` come first.

Each feedback line and each gyro sample has its own row. The pose from odometry is in the columns
`odom_...`, which calibration does not take for a measured position: odometry uses the wheels, and
calibration must not compare the wheels with themselves.
"""

from __future__ import annotations

from collections.abc import Iterator

from acsard.core.values import NS_PER_S, Estimate, GyroSample, Instant, Outputs
from acsard.recording.recorded_steps import Step

MEASURED = ("t [s]", "fr [rad/s]", "fl [rad/s]", "rl [rad/s]", "rr [rad/s]", "yaw_rate [rad/s]")
"""Columns that calibration reads. `t` is the wall-clock time, s since 1970. `yaw_rate` is from a
gyro, and the others are the speeds of the wheels.
"""

OUTPUT_COLUMNS = (
    "odom_x [m]", "odom_y [m]", "odom_yaw [rad]", "linear [m/s]", "angular [rad/s]",
    "applied_linear [m/s]", "applied_angular [rad/s]", "mode", "link", "source",
)  # fmt: skip
"""Columns with outputs of the robot. A row of a gyro sample leaves them empty."""

HEADER = ",".join([*MEASURED, *OUTPUT_COLUMNS])
MEASURED_HEADER = ",".join(MEASURED)

_NO_WHEELS = "," * 4
_NO_OUTPUTS = "," * len(OUTPUT_COLUMNS)


def rows(step: Step, outputs: Outputs) -> Iterator[str]:
    """Yield the CSV rows of a step, without line ends."""
    now = step.inputs.now
    for sample in step.inputs.gyro:
        yield gyro_columns(sample, now) + _NO_OUTPUTS
    if outputs.estimates:
        applied = f"{outputs.applied.linear:.6g},{outputs.applied.angular:.6g}"
        status = f"{outputs.mode},{outputs.link},{outputs.source}"
        for estimate in outputs.estimates:
            pose = f"{estimate.pose.x:.6f},{estimate.pose.y:.6f},{estimate.pose.yaw:.6f}"
            twist = f"{estimate.twist.linear:.6g},{estimate.twist.angular:.6g}"
            yield f"{wheel_columns(estimate)},{pose},{twist},{applied},{status}"


def measured(step: Step, outputs: Outputs) -> Iterator[str]:
    """Yield the CSV rows of a step with only the columns that calibration reads."""
    for sample in step.inputs.gyro:
        yield gyro_columns(sample, step.inputs.now)
    for estimate in outputs.estimates:
        yield wheel_columns(estimate)


def wheel_columns(estimate: Estimate) -> str:
    """Return the measured columns of a feedback line."""
    wheels = ",".join(f"{speed:.6g}" for speed in estimate.speeds.as_tuple())
    return f"{_seconds(estimate.at.wall_ns)},{wheels},"


def gyro_columns(sample: GyroSample, now: Instant) -> str:
    """Return the measured columns of a gyro sample.

    The time is the sample's stamp. If it has no stamp, the time is that of its arrival, which `now`
    converts from the monotonic to the wall clock.
    """
    arrived_ns = sample.at_ns + now.wall_ns - now.mono_ns
    at_ns = arrived_ns if sample.stamp_ns is None else sample.stamp_ns
    return f"{_seconds(at_ns)},{_NO_WHEELS}{sample.rate:.6g}"


def _seconds(wall_ns: int) -> str:
    return f"{wall_ns // NS_PER_S}.{wall_ns % NS_PER_S // 1000:06d}"
