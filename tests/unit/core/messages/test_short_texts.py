"""A message as one line of text contains the same facts as its JSON, except those for programs."""

from __future__ import annotations

import math
import re

import pytest
from msgspec.structs import replace

from acsard.core.messages.schema import (
    Cause,
    Header,
    Odometry,
    Pose,
    PoseStamped,
    PoseWithCovariance,
    Quaternion,
    Time,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from acsard.core.messages.short_texts import place, short, speeds
from tests.each import each
from tests.unit.screens import STATE

HEADER = Header(Time(), "odom")


def pose(x: float, y: float, yaw: float) -> Pose:
    return Pose(Vector3(x, y), Quaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))


def odometry(x: float, y: float, yaw: float, linear: float, angular: float) -> Odometry:
    covariance = [0.25] * 36
    twist = Twist(Vector3(linear), Vector3(z=angular))
    return Odometry(
        HEADER,
        "base_link",
        PoseWithCovariance(pose(x, y, yaw), covariance),
        TwistWithCovariance(twist, covariance),
    )


def figures(line: str) -> list[float]:
    return [float(text) for text in re.findall(r"[+-]\d+(?:\.\d+)?(?:e[+-]\d+)?", line)]


@each("yaw", [-3.1, -0.4, 0.0, 1.0, 3.1, 3.2, 6.0])
def test_the_heading_is_within_half_a_turn(yaw: float) -> None:
    angle = figures(short(PoseStamped(HEADER, pose(0.0, 0.0, yaw))))[2]
    assert -180.0 <= angle <= 180.0
    assert math.remainder(angle - math.degrees(yaw), 360.0) == pytest.approx(0.0, abs=0.051)


def test_lines_of_odometry_have_the_same_width() -> None:
    far = [odometry(x, 0.0, 0.0, v, 0.0) for x, v in ((0.0, 0.5), (999.9, -0.5), (-99.0, 0.0))]
    assert len({len(short(message)) for message in far}) == 1


@each("value", [1e300, -1e12, math.inf, math.nan])
def test_no_number_makes_the_line_longer_than_80_characters(value: float) -> None:
    assert len("".join(place(value, value, 0.0) + speeds(value, value))) < 80


def test_a_stopped_robot_says_why_once_and_with_the_numbers_that_clear_takes() -> None:
    causes = [Cause(n, "stop", "stopped", "", "", Time(), False, None) for n in (7, 12)]
    state = replace(STATE, mode="stopped", reason="stopped by ann", code="stopped")
    assert short(state).endswith("  stopped by ann")
    assert short(replace(state, causes=causes)).endswith("  stopped by ann (causes 7, 12)")
    assert short(replace(state, causes=causes[:1])).endswith("  stopped by ann (cause 7)")
    low = replace(state, reason="battery low")
    assert short(low).endswith("  stopped: battery low")
