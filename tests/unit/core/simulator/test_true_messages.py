"""Tests of the simulated robot's true state as it is published on the bus."""

from __future__ import annotations

import math

import pytest

from acsard.core.config.settings import OdometryConfig
from acsard.core.incoming.commands import Arrival
from acsard.core.incoming.imu import reading
from acsard.core.messages.encodings import FORMATS, Format, encode
from acsard.core.messages.schema import Time, Vector3
from acsard.core.simulator.simulated_robot import Observation
from acsard.core.simulator.true_messages import true_pose, turn_rate
from acsard.core.values import Pose

SIGHT = Observation(7, Pose(1.5, -2.0, math.pi / 2), 0.25)
WALL_NS = 1_700_000_003_250_000_001


def test_the_true_pose_is_the_observed_one_with_the_time_of_the_observation() -> None:
    pose = true_pose(SIGHT, WALL_NS)
    assert pose.header.stamp == Time(1_700_000_003, 250_000_001)
    assert pose.pose.position == Vector3(1.5, -2.0, 0.0)
    turn = pose.pose.orientation
    assert (turn.x, turn.y, turn.z, turn.w) == pytest.approx((0.0, 0.0, 0.5**0.5, 0.5**0.5))


def test_the_true_pose_is_not_in_a_frame_of_the_odometry() -> None:
    frames = OdometryConfig()
    assert true_pose(SIGHT, WALL_NS).header.frame_id not in (frames.odom_frame, frames.base_frame)


@pytest.mark.parametrize("form", FORMATS)
def test_a_sample_of_the_simulated_gyro_is_read_like_one_of_any_gyro(form: Format) -> None:
    message = turn_rate(SIGHT, "base_link", WALL_NS)
    sample, _ = reading(Arrival("imu", True, encode(message, form), "", 7, None, ""))
    assert (sample.at_ns, sample.stamp_ns, sample.rate) == (7, WALL_NS, 0.25)
    assert message.orientation_covariance[0] == message.linear_acceleration_covariance[0] == -1.0
