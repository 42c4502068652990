"""A simulated robot is observed; its true pose and its gyro go onto the bus."""

from __future__ import annotations

import math

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, OdometryConfig, SimConfig
from acsard.core.incoming.commands import Arrival
from acsard.core.incoming.imu import reading
from acsard.core.messages.encodings import FORMATS, Format, encode
from acsard.core.messages.schema import Time, Vector3
from acsard.core.simulator.fake_mcu import MS, FakeMcu
from acsard.core.simulator.simulated_robot import OBSERVATION_PERIOD_NS, Observation, WatchedMcu
from acsard.core.simulator.true_messages import true_pose, turn_rate
from acsard.core.values import Pose

TRUE = Config(sim=SimConfig(motor_time_constant=0.0))
LINE = b"ap02.00,bn02.00,cn02.00,dp02.00\r\n"
RATE = 2.0 * 2 * 0.05 / 0.30
"""Turn rate that the line commands, rad/s."""


def observations(
    config: Config = TRUE, seconds: float = 1.0, step_ms: int = 5
) -> list[Observation]:
    """Return all observations of a robot that is commanded to turn from 100 ms on."""
    sights: list[Observation] = []
    mcu = WatchedMcu(config, 0, sights.append)
    for ms in range(0, int(seconds * 1000) + 1, step_ms):
        if ms >= 100 and ms % 20 == 0:
            mcu.receive(ms * MS, LINE)
        mcu.advance(ms * MS)
    return sights


def test_the_robot_is_observed_every_10_ms_for_any_step_size() -> None:
    for step_ms in (1, 5, 20):
        assert [sight.at_ns for sight in observations(step_ms=step_ms)] == [
            (n + 1) * OBSERVATION_PERIOD_NS for n in range(100)
        ]


def test_an_observation_has_the_true_pose_of_its_time() -> None:
    config = Config(sim=replace(TRUE.sim, track_multiplier=1.6))
    late, early = observations(config)[-1], observations(config)[49]
    turned = late.pose.yaw - early.pose.yaw
    assert turned == pytest.approx(RATE / 1.6 * 0.5)


def test_an_observed_board_answers_the_same_bytes() -> None:
    watched, alone = WatchedMcu(TRUE, 0, lambda sight: None), FakeMcu(TRUE)
    for mcu in (watched, alone):
        mcu.receive(0, LINE)
    assert watched.advance(100 * MS) == alone.advance(100 * MS) != b""


def test_the_next_observation_is_the_next_event_of_an_idle_board() -> None:
    mcu = WatchedMcu(TRUE, 7, lambda sight: None)
    assert mcu.next_ns() == 7 + OBSERVATION_PERIOD_NS
    mcu.receive(7, LINE)
    assert mcu.next_ns() < 7 + OBSERVATION_PERIOD_NS


def test_the_gyro_measures_the_true_turn_rate() -> None:
    sights = observations()
    assert [sight.gyro for sight in sights[50:]] == pytest.approx([RATE] * 50)
    assert sum(sight.gyro for sight in sights) * 0.01 == pytest.approx(sights[-1].pose.yaw)


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
