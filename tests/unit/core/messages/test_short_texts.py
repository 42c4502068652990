"""A message as one line of text contains the same facts as its JSON, except those for programs."""

from __future__ import annotations

import math
import re

import pytest
from msgspec.structs import replace

from acsard.core.messages.schema import (
    Battery,
    BatterySummary,
    Header,
    Odometry,
    Pose,
    PoseStamped,
    PoseWithCovariance,
    Quaternion,
    RobotState,
    Time,
    Twist,
    TwistStamped,
    TwistWithCovariance,
    Vector3,
)
from acsard.core.messages.short_texts import SHORT_TEXTS, place, short, speeds
from tests.each import each

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


def test_odometry_is_shown_as_pose_and_speeds_with_units() -> None:
    line = short(odometry(1.25, -0.5, math.radians(90.0), 0.5, -0.2))
    text = "x +1.250 m y -0.500 m yaw +90.0° forward +0.50 m/s turn -0.20 rad/s"
    assert " ".join(line.split()) == text


@each("yaw", [-3.1, -0.4, 0.0, 1.0, 3.1, 3.2, 6.0])
def test_the_heading_is_within_half_a_turn(yaw: float) -> None:
    angle = figures(short(PoseStamped(HEADER, pose(0.0, 0.0, yaw))))[2]
    assert -180.0 <= angle <= 180.0
    assert math.remainder(angle - math.degrees(yaw), 360.0) == pytest.approx(0.0, abs=0.051)


def test_a_stamped_twist_is_shown_as_its_two_speeds() -> None:
    line = short(TwistStamped(HEADER, Twist(Vector3(0.333), Vector3(z=1.0))))
    assert figures(line) == [0.33, 1.0]


def test_lines_of_odometry_have_the_same_width() -> None:
    far = [odometry(x, 0.0, 0.0, v, 0.0) for x, v in ((0.0, 0.5), (999.9, -0.5), (-99.0, 0.0))]
    assert len({len(short(message)) for message in far}) == 1


@each("value", [1e300, -1e12, math.inf, math.nan])
def test_no_number_makes_the_line_longer_than_80_characters(value: float) -> None:
    assert len("".join(place(value, value, 0.0) + speeds(value, value))) < 80


def test_the_line_of_a_state_ends_with_its_warnings() -> None:
    state = RobotState(
        Time(), "ready", "waiting for a command", 0.0, 0.0, 0.0, 0.0, 0.0, [], "up", "", [], "", {}
    )  # fmt: skip
    assert short(state).endswith("  ready: waiting for a command")
    bad = replace(
        state, recording_error="the disk is full", certificate="expires", certificate_days=10.0
    )
    assert short(bad).endswith("  WARNING: certificate expires in 10 days, recording fails")
    full = replace(state, battery=BatterySummary(24.5, 87.0, None, "ok"))
    assert short(full).endswith("  ready: waiting for a command  battery 87 %")


def test_a_battery_is_shown_as_voltage_current_and_charge() -> None:
    assert short(Battery(HEADER, voltage=24.5, percentage=0.87)) == "24.50 V  - A  87 %"


def test_common_message_types_have_a_short_text() -> None:
    assert {kind.__name__ for kind in SHORT_TEXTS} >= {"Odometry", "RobotState", "PoseStamped"}
