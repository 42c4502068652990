"""Tests that turn the daemon's messages into lines with their odometry."""

from __future__ import annotations

import math

import pytest
from msgspec.structs import replace

from acsard.calibration.error_budget.daemon_messages import MessageCollector
from acsard.core.config.settings import Config, McuConfig, RatesConfig
from acsard.core.messages.schema import (
    DiagnosticArray,
    DiagnosticStatus,
    Header,
    JointState,
    KeyValue,
    Odometry,
    Pose,
    PoseWithCovariance,
    Quaternion,
    RobotState,
    Time,
    Twist,
    TwistStamped,
    TwistWithCovariance,
    Vector3,
)
from acsard.core.values import NS_PER_S

START = Time(1000, 0)
ZERO = Twist(Vector3(), Vector3())


def state(lines: int, gyro: str = "off", impossible: int = 0) -> RobotState:
    counters = {"lines": lines, "line_implausible": impossible}
    return RobotState(
        START, "ready", "", 0.0, 0.0, 0.0, 0.0, 0.0, [], "up", "", [], "", counters, gyro=gyro
    )


def diagnostics(**values: str) -> DiagnosticArray:
    rows = [KeyValue(key, value) for key, value in values.items()]
    return DiagnosticArray(Header(), [DiagnosticStatus(0, "acsard: any", "", "", rows)])


def wheels(seconds: float, speed: float = 1.0) -> JointState:
    at = Header(Time.from_ns(START.to_ns() + round(seconds * NS_PER_S)))
    return JointState(at, velocity=[speed, 2.0, 3.0, 4.0], position=[5.0, 6.0, 7.0, 8.0])


def odom(seconds: float, yaw: float = 0.5) -> Odometry:
    covariance = [0.0] * 36
    covariance[35] = 0.25
    turn = Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    pose = PoseWithCovariance(Pose(Vector3(), turn), covariance)
    twist = TwistWithCovariance(ZERO, covariance)
    return Odometry(wheels(seconds).header, "base_link", pose, twist)


def test_wheel_states_with_another_number_of_wheels_are_ignored() -> None:
    feed = MessageCollector(Config(), state(10))
    message = wheels(0.01)
    message.velocity.pop()
    for part in (odom(0.01), message, odom(0.02), wheels(0.02)):
        feed.add(part)
    (line,) = feed.received(state(11), diagnostics()).lines
    assert line.at == 0.02


def test_two_messages_of_one_stamp_make_a_line_in_any_order() -> None:
    feed = MessageCollector(Config(), state(10))
    for message in (wheels(0.01), odom(0.01), odom(0.02, 1.5), wheels(0.02)):
        feed.add(message)
    first, other = feed.received(state(12), diagnostics()).lines
    assert (first.at, first.speeds, first.positions) == (
        0.01,
        (1.0, 2.0, 3.0, 4.0),
        (5.0, 6.0, 7.0, 8.0),
    )
    assert first.yaw == pytest.approx(0.5)
    assert first.yaw_variance == 0.25
    assert other.yaw == pytest.approx(1.5)


def test_half_a_line_is_not_a_line_and_is_dropped_in_time() -> None:
    feed = MessageCollector(Config(), state(0))
    for n in range(1000):
        feed.add(wheels(n / 100))
    assert feed.received(state(0), diagnostics()).lines == []
    feed.add(odom(0.0))
    assert feed.received(state(0), diagnostics()).lines == []


def test_the_times_of_the_sent_lines_are_the_stamps_of_the_applied_commands() -> None:
    feed = MessageCollector(Config(), state(0))
    feed.add(TwistStamped(wheels(0.25).header, ZERO))
    assert feed.received(state(0), diagnostics()).sent == [0.25]


@pytest.mark.parametrize(
    ("lines", "impossible", "complete"), [(102, 0, True), (140, 0, False), (140, 40, True)]
)
def test_lines_that_the_daemon_counted_but_did_not_arrive_here_are_noticed(
    lines: int, impossible: int, complete: bool
) -> None:
    feed = MessageCollector(Config(), state(0))
    for n in range(100):
        feed.add(wheels(n / 100))
        feed.add(odom(n / 100))
    assert feed.received(state(lines, impossible=impossible), diagnostics()).complete is complete


@pytest.mark.parametrize(("lines", "coarse"), [(90, False), (110, True)])
def test_coarse_encoders_are_noticed_by_the_lines_that_state_counts(
    lines: int, coarse: bool
) -> None:
    last = state(1000)
    last.counters["coarse_encoder_lines"] = lines
    assert MessageCollector(Config(), state(0)).received(last, diagnostics()).coarse is coarse


def test_a_daemon_with_a_limited_rate_does_not_send_all_lines() -> None:
    slow = replace(Config(), rates=RatesConfig(odom=10.0))
    assert not MessageCollector(slow, state(0)).received(state(0), diagnostics()).complete


def test_counts_are_in_force_only_if_the_link_check_has_samples() -> None:
    asked = replace(Config(), mcu=McuConfig(link_check="auto", encoder_counts=400))
    for check, counted in (("checked with samples", True), ("plain", False)):
        assert (
            MessageCollector(asked, state(0)).received(state(0), diagnostics(check=check)).counted
            is counted
        )


@pytest.mark.parametrize(
    ("does", "used"),
    [("used", True), ("disagrees", True), ("silent", False), ("waiting for turn", False)],
)
def test_the_heading_is_the_gyros_where_it_is_used(does: str, used: bool) -> None:
    assert MessageCollector(Config(), state(0)).received(state(0, does), diagnostics()).gyro is used


def test_a_learned_track_is_relative_to_the_configured_one() -> None:
    both = {"wheel_separation_multiplier": "1.500", "learned_multiplier": "1.650"}
    both["learned_multiplier_std"] = "0.033"
    for in_use, used in (("1.500", False), ("1.650", True)):
        learned = diagnostics(**both, multiplier_in_use=in_use)
        received = MessageCollector(Config(), state(0)).received(state(0), learned)
        assert (received.learned, received.deviation) == pytest.approx((1.1, 0.02))
        assert received.used is used
    assert MessageCollector(Config(), state(0)).received(state(0), diagnostics()).learned is None
