"""The simulated base and what is observed of it: motors with a lag, the true path, the gyro."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import DriveConfig, OdometryConfig, SimConfig
from acsard.core.incoming.commands import Arrival
from acsard.core.incoming.imu import reading
from acsard.core.messages.encodings import FORMATS, Format, encode
from acsard.core.messages.schema import Time, Vector3
from acsard.core.simulator.simulated_robot import Observation
from acsard.core.simulator.true_messages import true_pose, turn_rate
from acsard.core.simulator.vehicle import Vehicle
from acsard.core.values import Pose
from tests.each import each

LAG, RADIUS, TRACK = 0.1, 0.05, 0.30
SPIN = (3.0, -3.0, -3.0, 3.0)
"""Set points that the host takes for 1 rad/s on the spot."""

four = st.lists(st.floats(-50, 50), min_size=4, max_size=4)


def moved(
    seconds: float, *set_points: float, lag: float = 0.0, drive: DriveConfig | None = None,
    track: float = 1.0, **changes: float,
) -> Vehicle:  # fmt: skip
    """Return a vehicle after this time from rest; a, b, c, d are right, left, left, right."""
    sim = SimConfig(motor_time_constant=lag, track_multiplier=track)
    made = Vehicle(sim, drive or DriveConfig())
    for name, value in changes.items():
        setattr(made, name, value)
    made.set_points[:] = set_points
    made.advance(seconds)
    return made


@each("seconds", [0.001, 0.05, 0.1, 0.5, 3.0])
@each("lag", [0.0, LAG])
def test_a_motor_approaches_its_set_point_exponentially(seconds: float, lag: float) -> None:
    made = moved(seconds, 10.0, -5.0, 0.0, 2.0, lag=lag)
    share = 1 - math.exp(-seconds / lag) if lag else 1.0
    assert made.speeds == pytest.approx([10.0 * share, -5.0 * share, 0.0, 2.0 * share])
    turned = seconds - lag * share
    assert made.angles == pytest.approx([10.0 * turned, -5.0 * turned, 0.0, 2.0 * turned])
    for nothing in (0.0, -1.0):
        made.advance(nothing)
    assert made.angles[0] == pytest.approx(10.0 * turned)
    made.set_points[:] = [0.0] * 4
    made.advance(10.0)
    assert made.speeds == [0.0] * 4


@given(st.lists(st.floats(1e-4, 0.5), min_size=1, max_size=12), four)
def test_motion_does_not_depend_on_the_time_steps(pieces: list[float], goal: list[float]) -> None:
    whole, cut = moved(sum(pieces), *goal, lag=LAG), moved(0.0, *goal, lag=LAG)
    for piece in pieces:
        cut.advance(piece)
    assert cut.speeds == pytest.approx(whole.speeds, abs=1e-6)
    assert cut.angles == pytest.approx(whole.angles, abs=1e-6)
    assert (cut.pose.x, cut.pose.y) == pytest.approx((whole.pose.x, whole.pose.y), abs=1e-6)
    assert math.remainder(cut.pose.yaw - whole.pose.yaw, math.tau) == pytest.approx(0.0, abs=1e-6)


CURVE = ((0.5 + 0.5 * TRACK / 2) / RADIUS, (0.5 - 0.5 * TRACK / 2) / RADIUS)
"""Right and left speed for 0.5 m/s and 0.5 rad/s, a circle of 1 m radius."""


@each(
    ("seconds", "set_points", "pose"),
    [
        (100.0, (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        (2.0, (10.0, 10.0, 10.0, 10.0), (1.0, 0.0, 0.0)),
        (2.0, (-10.0, -10.0, -10.0, -10.0), (-1.0, 0.0, 0.0)),
        (0.7, SPIN, (0.0, 0.0, 0.7)), (12.0, SPIN, (0.0, 0.0, 12.0 - 4 * math.pi)),
        (math.pi, (CURVE[0], CURVE[1], CURVE[1], CURVE[0]), (1.0, 1.0, math.pi / 2)),
        # The mean of each side counts.
        (math.pi, (CURVE[0] + 1, CURVE[1] - 2, CURVE[1] + 2, CURVE[0] - 1),
         (1.0, 1.0, math.pi / 2)),
    ],
)  # fmt: skip
def test_the_path_follows_from_the_wheels(
    seconds: float, set_points: tuple[float, ...], pose: tuple[float, ...]
) -> None:
    made = moved(seconds, *set_points)
    assert (made.pose.x, made.pose.y, made.pose.yaw) == pytest.approx(pose)
    assert math.remainder(made.turned - made.pose.yaw, math.tau) == pytest.approx(0.0, abs=1e-9)


def test_the_radius_multipliers_and_the_effective_track_shape_the_path() -> None:
    drive = DriveConfig(0.1, 0.5, 2.0, 0.9, 1.1)
    made = moved(0.5, 1.0, 1.0, 1.0, 1.0, drive=drive)
    assert made.pose.yaw == pytest.approx(0.5 * (0.11 - 0.09) / 1.0)
    assert math.hypot(made.pose.x, made.pose.y) == pytest.approx(0.5 * 0.1, rel=1e-4)
    # The host does not know the true track.
    assert moved(10.0, *SPIN, track=1.6).turned == pytest.approx(10.0 / 1.6)


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_slip_reduces_the_turn_and_load_every_speed_by_its_share(share: float) -> None:
    slipped = moved(0.1, *SPIN, turn_slip=share)
    assert slipped.pose.yaw == pytest.approx((1 - share) * 0.1)
    assert slipped.angles == pytest.approx([0.3, -0.3, -0.3, 0.3])
    assert moved(1.0, 3.0, 3.0, 3.0, 3.0, turn_slip=share).pose.x == pytest.approx(0.15)
    loaded = moved(2.0, 10.0, 10.0, -10.0, 10.0, load=share)
    assert loaded.speeds == pytest.approx([s * (1 - share) for s in (10.0, 10.0, -10.0, 10.0)])


@pytest.mark.parametrize("speed", [0.5, -0.12])
def test_a_push_moves_the_vehicle_whatever_its_motors_do(speed: float) -> None:
    made = moved(1.0, 10.0, -10.0, 3.0, 0.0)
    before = made.pose
    made.advance(2.0, push=speed)
    assert made.speeds == pytest.approx([speed / RADIUS] * 4, rel=1e-6)
    made.set_points[:] = [0.0] * 4
    made.advance(1.0)
    assert made.speeds == [0.0] * 4
    assert math.dist((made.pose.x, made.pose.y), (before.x, before.y)) > 1.5 * abs(speed)


# what is observed

SIGHT = Observation(7, Pose(1.5, -2.0, math.pi / 2), 0.25)
WALL_NS = 1_700_000_003_250_000_001


def test_the_true_pose_has_the_time_of_the_observation_and_no_frame_of_the_odometry() -> None:
    pose = true_pose(SIGHT, WALL_NS)
    assert pose.header.stamp == Time(1_700_000_003, 250_000_001)
    frames = OdometryConfig()
    assert pose.header.frame_id not in (frames.odom_frame, frames.base_frame)
    assert pose.pose.position == Vector3(1.5, -2.0, 0.0)
    turn = pose.pose.orientation
    assert (turn.x, turn.y, turn.z, turn.w) == pytest.approx((0.0, 0.0, 0.5**0.5, 0.5**0.5))


@pytest.mark.parametrize("form", FORMATS)
def test_a_sample_of_the_simulated_gyro_is_read_like_one_of_any_gyro(form: Format) -> None:
    message = turn_rate(SIGHT, "base_link", WALL_NS)
    sample, _ = reading(Arrival("imu", True, encode(message, form), "", 7, None, ""))
    assert (sample.at_ns, sample.stamp_ns, sample.rate) == (7, WALL_NS, 0.25)
    assert message.orientation_covariance[0] == message.linear_acceleration_covariance[0] == -1.0
