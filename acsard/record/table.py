"""What a robot that lives again did, as lines of CSV: what `acsard calibrate` reads comes first.

A line for each feedback, with what was wished and what went at that time, and one for each report
of a gyro. Where the robot was by its own odometry is no column that calibration takes for a
measurement: wheels cannot be compared with themselves.
"""

from __future__ import annotations

from collections.abc import Iterator

from acsard.record.steps import Step
from acsard.values import NS_PER_S, Estimate, GyroSample, Instant, Outputs

MEASURED = ("t [s]", "fr [rad/s]", "fl [rad/s]", "rl [rad/s]", "rr [rad/s]", "yaw_rate [rad/s]")
"""`t` is since 1970; `yaw_rate` a gyro's."""

TOLD = (
    "odom_x [m]", "odom_y [m]", "odom_yaw [rad]", "linear [m/s]", "angular [rad/s]",
    "applied_linear [m/s]", "applied_angular [rad/s]", "mode", "link", "source",
)  # fmt: skip

HEADER = ",".join([*MEASURED, *TOLD])
MEASURED_HEADER = ",".join(MEASURED)

_NO_WHEELS = "," * 4
_NOTHING_TOLD = "," * len(TOLD)


def rows(step: Step, outputs: Outputs) -> Iterator[str]:
    """The lines of one step, without line ends."""
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
    """Only what calibration reads."""
    for sample in step.inputs.gyro:
        yield turned(sample, step.inputs.now)
    for estimate in outputs.estimates:
        yield rolled(estimate)


def rolled(estimate: Estimate) -> str:
    """The measured columns of a feedback line."""
    wheels = ",".join(f"{speed:.6g}" for speed in estimate.speeds.as_tuple())
    return f"{_seconds(estimate.at.wall_ns)},{wheels},"


def turned(sample: GyroSample, now: Instant) -> str:
    """The measured columns of a gyro's report: when it was measured, or else when it arrived."""
    arrived_ns = sample.at_ns + now.wall_ns - now.mono_ns
    at_ns = arrived_ns if sample.stamp_ns is None else sample.stamp_ns
    return f"{_seconds(at_ns)},{_NO_WHEELS}{sample.rate:.6g}"


def _seconds(wall_ns: int) -> str:
    return f"{wall_ns // NS_PER_S}.{wall_ns % NS_PER_S // 1000:06d}"
