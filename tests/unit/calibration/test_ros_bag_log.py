"""Tests of the table of a ROS 2 bag: its topics, wheels, units, axes and clocks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from acsard.calibration.log_table import LogError, Table
from acsard.calibration.ros_bag_log import Choice, RosMessage, speeds_of, table, wheel_of
from acsard.calibration.runs import runs
from acsard.calibration.solve import Calibration, calibrate
from acsard.core.config.settings import DriveConfig, JointsConfig
from tests.each import each
from tests.unit.calibration.bags import (
    imu,
    in_order,
    joint_states,
    message,
    odometry,
    pose,
    poses,
    wheel_odometry,
)
from tests.unit.calibration.cut import calibrated, usual
from tests.unit.calibration.cut import table as csv_table
from tests.unit.calibration.robots import Drive

OURS = JointsConfig().as_tuple()

SHORT = usual(plan=[(2, 0, 0), (4, 0.4, 0), (4, 0, 1.0), (4, 0, -1.0), (1, 0, 0)])


def of(*topics: Iterator[RosMessage], use: Sequence[str] = (), axis: str = "") -> Table:
    return table(in_order(*topics), OURS, Choice(tuple(use), axis))


def result(bag: Table) -> Calibration:
    return calibrate(runs(bag), DriveConfig())


def finite(bag: Table, name: str) -> int:
    return int(np.isfinite(bag.columns[name]).sum())


@pytest.mark.slow
@pytest.mark.parametrize("speeds", [False, True])
def test_a_bag_gives_the_same_calibration_as_the_csv_of_the_drive(speeds: bool) -> None:
    drive = usual()
    bag = of(joint_states(drive, speeds=speeds), imu(drive), poses(drive))
    expected = calibrated(csv_table(drive))
    calibration = result(bag)
    assert calibration.reference == expected.reference == "yaw_rate and positions"
    difference = calibration.multipliers.values - expected.multipliers.values
    assert np.all(np.abs(difference) < expected.multipliers.std / 2)


def test_the_topics_in_use_are_named() -> None:
    bag = of(joint_states(SHORT), imu(SHORT), poses(SHORT))
    assert bag.notes[0] == (
        "used: the wheels from /joint_states (JointState), the turn rates from /imu/data (Imu) "
        "about its z axis, the positions from /slam/pose (PoseStamped)"
    )


# the wheels


@each(
    ("joint", "column"),
    [
        ("front_left_wheel_joint", "fl"), ("wheel_rear_right", "rr"), ("back_left_wheel", "rl"),
        ("left_wheel_joint", "left"), ("rightWheel", "right"), ("fl_joint", "fl"),
        ("wheel_lr", "rl"), ("wheel_r_joint", "right"), ("leftfront_wheel", "fl"),
        ("left_caster_joint", ""), ("arm_1", ""), ("front_left_steering_joint", ""),
        ("right_arm_upper_left", ""),
    ],
)  # fmt: skip
def test_the_name_of_a_joint_shows_its_wheel(joint: str, column: str) -> None:
    assert wheel_of(joint) == column


@each(
    ("names", "columns"),
    [
        (("l_wheel", "r_wheel"), {"left", "right"}),
        (("fl_wheel", "rl_wheel", "fr_wheel", "rr_wheel"), {"fl", "rl", "fr", "rr"}),
        (("a_left", "b_left", "c_left", "a_right", "b_right", "c_right"), {"left", "right"}),
        (("arm_left", "left_wheel", "arm_right", "right_wheel"), {"left", "right"}),
    ],
)
def test_the_columns_follow_the_joints(names: tuple[str, ...], columns: set[str]) -> None:
    bag = of(joint_states(SHORT, names=names), imu(SHORT))
    assert set(bag.columns) == {"t", "yaw_rate", *columns}
    run = runs(bag).runs[0]
    angle = run.rolled[1][-1]
    assert angle == pytest.approx(SHORT.right.sum() * 0.01, abs=0.2)


def test_configured_joints_have_priority_over_joint_names() -> None:
    names = ("b", "c", "a", "d")
    bag = table(
        in_order(joint_states(SHORT, names=names), imu(SHORT)), ("a", "b", "c", "d"), Choice()
    )
    right = bag.columns["fr"]
    assert np.nanmean(np.abs(right - bag.columns["rr"])) == pytest.approx(0.0)
    assert np.nanmean(np.abs(right - bag.columns["fl"])) > 1.0


def total(t: list[float], angles: list[float]) -> float:
    times, speeds = speeds_of(np.array(t), np.array(angles)[:, None])
    return float(np.sum((speeds[1:, 0] + speeds[:-1, 0]) / 2 * np.diff(times)))


def test_uneven_times_do_not_change_the_angle() -> None:
    """Every second message is 9 ms late, as if the logger read two messages at once."""
    t = [k * 0.01 + 0.009 * (k % 2) for k in range(2000)]
    assert total(t, [5.0 * k * 0.01 for k in range(2000)]) == pytest.approx(99.9, abs=0.2)


def test_angles_within_one_turn_are_unwrapped() -> None:
    t = [k * 0.01 for k in range(2000)]
    wrapped = [math.remainder(5.0 * at, 2 * math.pi) for at in t]
    assert total(t, wrapped) == pytest.approx(99.9, abs=0.2)


def test_an_angle_that_restarts_at_0_is_not_a_turn_backward() -> None:
    t = [k * 0.01 for k in range(2000)]
    angles = [5.0 * at for at in t]
    angles[1000:] = [angle - angles[1000] for angle in angles[1000:]]
    assert total(t, angles) == pytest.approx(99.9, abs=0.3)


def test_speeds_are_used_if_the_angles_never_change() -> None:
    def both() -> Iterator[RosMessage]:
        for at, left, right in zip(SHORT.t, SHORT.left, SHORT.right, strict=True):
            yield message(
                "/joint_states", "JointState", float(at), name=["l_wheel", "r_wheel"],
                position=[0.0, 0.0], velocity=[float(left), float(right)],
            )  # fmt: skip

    bag = of(both(), imu(SHORT))
    assert np.nanmax(np.abs(bag.columns["left"])) == np.abs(SHORT.left).max()


# the choice


def test_several_topics_of_a_type_are_named_and_one_can_be_chosen() -> None:
    topics = [list(imu(SHORT, "/imu/data")), list(imu(SHORT, "/imu/raw"))]
    with pytest.raises(LogError, match=r"/imu/data .Imu., /imu/raw .Imu.; choose one, .*--topic"):
        of(joint_states(SHORT), *map(iter, topics))
    bag = of(joint_states(SHORT), *map(iter, topics), use=["/imu/raw"])
    assert "/imu/raw" in bag.notes[0]


def test_only_the_sensor_that_is_named_is_used() -> None:
    bag = of(joint_states(SHORT), imu(SHORT), poses(SHORT), use=["/slam/pose"])
    assert "yaw_rate" not in bag.columns
    assert finite(bag, "x") == len(SHORT.place)


def test_a_named_topic_whose_joints_are_not_wheels_is_refused_and_not_replaced_by_another() -> None:
    arm = joint_states(SHORT, "/arm/joint_states", names=("a", "b"))
    with pytest.raises(
        LogError, match=r"joints of /arm/joint_states .* but are a, b\. .*leave out --topic /arm/"
    ):
        of(joint_states(SHORT), arm, imu(SHORT), use=["/arm/joint_states"])


def test_a_topic_with_few_messages_is_not_a_candidate() -> None:
    few = list(imu(SHORT, "/imu/raw"))[:5]
    assert "/imu/data" in of(joint_states(SHORT), imu(SHORT), iter(few)).notes[0]


def test_odometry_that_is_computed_from_the_wheels_is_refused() -> None:
    with pytest.raises(LogError, match=r"/odom .Odometry. shows exactly the same turns as"):
        of(joint_states(SHORT), wheel_odometry(SHORT))


def test_odometry_beside_a_gyro_is_not_used_unless_it_is_named() -> None:
    def topics() -> list[Iterator[RosMessage]]:
        return [joint_states(SHORT), imu(SHORT), wheel_odometry(SHORT)]

    bag = of(*topics())
    assert "x" not in bag.columns
    assert "/odom (Odometry) not used" in bag.notes[1]
    assert "--topic /imu/data --topic /odom" in bag.notes[1]
    assert "x" in of(*topics(), use=["/imu/data", "/odom"]).columns


def true_odometry(drive: Drive) -> Iterator[RosMessage]:
    return odometry(drive.t, list(drive.where), drive.yaw, "/lidar/odometry")


def test_odometry_of_a_sensor_gives_positions_and_yaw() -> None:
    bag = of(joint_states(SHORT), true_odometry(SHORT))
    assert finite(bag, "x") == finite(bag, "yaw") == len(SHORT.t)
    yaw = bag.columns["yaw"][np.isfinite(bag.columns["yaw"])]
    assert np.allclose(np.unwrap(yaw), SHORT.yaw, atol=1e-6)


@pytest.mark.parametrize("yaw", [False, True])
def test_poses_give_a_yaw_only_if_they_have_an_orientation(yaw: bool) -> None:
    bag = of(joint_states(SHORT), poses(SHORT, yaw=yaw))
    assert ("yaw" in bag.columns) == yaw


def test_a_tilted_pose_gives_the_yaw_of_its_quaternion() -> None:
    """The pose has 30 deg of yaw and 10 deg of roll.

    A computation from z and w alone would give 30.4 deg.
    """

    def tilted() -> Iterator[RosMessage]:
        for at in np.arange(0.0, 10.0, 0.2):
            yaw, roll = math.radians(3.0 * float(at)), math.radians(10.0)
            turn = {
                "x": math.cos(yaw / 2) * math.sin(roll / 2),
                "y": math.sin(yaw / 2) * math.sin(roll / 2),
                "z": math.sin(yaw / 2) * math.cos(roll / 2),
                "w": math.cos(yaw / 2) * math.cos(roll / 2),
            }
            where = pose(complex(at), 0.0) | {"orientation": turn}
            yield message("/pose", "PoseStamped", float(at), pose=where)

    yaw = of(joint_states(SHORT), tilted()).columns["yaw"]
    assert np.nanmax(yaw) == pytest.approx(math.radians(3.0 * 9.8), abs=1e-9)


# the axis of the IMU


@each(("axis", "sign", "option"), [(0, 1.0, "x"), (0, -1.0, "-x"), (1, 1.0, "y"), (1, -1.0, "-y")])
def test_an_imu_on_its_side_is_refused_with_the_axis_that_follows_the_wheels(
    axis: int, sign: float, option: str
) -> None:
    with pytest.raises(
        LogError, match=rf"z axis .* but the rate about its {'xyz'[axis]} axis .*={option}$"
    ):
        of(joint_states(SHORT), imu(SHORT, axis=axis, sign=sign))
    bag = of(joint_states(SHORT), imu(SHORT, axis=axis, sign=sign), axis=option)
    rate = bag.columns["yaw_rate"]
    assert np.allclose(rate[np.isfinite(rate)], SHORT.gyro)


def test_an_imu_upside_down_is_turned_by_the_option() -> None:
    bag = of(joint_states(SHORT), imu(SHORT, sign=-1.0), axis="-z")
    rate = bag.columns["yaw_rate"]
    assert np.allclose(rate[np.isfinite(rate)], SHORT.gyro)


# the clocks


def test_stamps_of_another_clock_are_moved_to_the_clock_of_the_recording() -> None:
    bag = of(joint_states(SHORT), imu(SHORT, late=1e6))
    assert "different clocks, 1e+06 s apart" in bag.notes[1]
    gyro = bag.columns["t"][np.isfinite(bag.columns["yaw_rate"])]
    assert np.allclose(gyro - gyro[0], SHORT.gyro_t - SHORT.gyro_t[0], atol=1e-4)
    assert abs(gyro[0] - np.nanmin(bag.columns["t"])) < 0.1


def test_messages_without_a_stamp_have_the_time_of_their_recording() -> None:
    unstamped = (replace_stamp(entry, 0, 0) for entry in imu(SHORT))
    bag = of(joint_states(SHORT), unstamped)
    gyro = bag.columns["t"][np.isfinite(bag.columns["yaw_rate"])]
    assert np.allclose(gyro - gyro[0], SHORT.gyro_t - SHORT.gyro_t[0], atol=1e-4)


def replace_stamp(entry: RosMessage, sec: int, nanosec: int) -> RosMessage:
    stamp = sec.to_bytes(4, "little") + nanosec.to_bytes(4, "little")
    return entry._replace(data=entry.data[:4] + stamp + entry.data[12:])


# what is wrong


def as_encoding(messages: Iterator[RosMessage], encoding: str) -> Iterator[RosMessage]:
    return (entry._replace(encoding=encoding) for entry in messages)


def cut(messages: Iterator[RosMessage]) -> Iterator[RosMessage]:
    return (entry._replace(data=entry.data[:20]) for entry in messages)


def again(drive: Drive) -> Iterator[RosMessage]:
    yield from joint_states(drive)
    for entry in joint_states(drive):
        yield entry._replace(wall_ns=entry.wall_ns + 60 * 10**9)


@each(
    ("topics", "why"),
    [
        ([imu(SHORT)], "no wheel angles.*The bag contains /imu/data .Imu."),
        ([], "no wheel angles.*no messages at all"),
        ([joint_states(SHORT, names=("a", "b")), imu(SHORT)], r"but are a, b\. .*\[joints\]"),
        ([joint_states(SHORT)], "nothing with which to compare the wheels"),
        ([joint_states(SHORT), as_encoding(imu(SHORT), "ros1")], "encoded as ros1, not as cdr"),
        ([cut(joint_states(SHORT)), imu(SHORT)], "of /joint_states .JointState. cannot be read"),
        ([again(SHORT), imu(SHORT)], "go back by 15 s in the middle"),
    ],
)
def test_a_bag_that_lacks_data_is_refused_with_the_reason(
    topics: list[Iterator[RosMessage]], why: str
) -> None:
    with pytest.raises(LogError, match=why):
        of(*[iter(list(topic)) for topic in topics])


def test_a_missing_topic_is_refused_with_a_list_of_the_topics_in_the_bag() -> None:
    with pytest.raises(
        LogError, match=r"no topic /imu that can be used. The bag contains .*/imu/data"
    ):
        of(joint_states(SHORT), imu(SHORT), use=["/imu"])


def test_an_axis_option_without_an_imu_is_refused() -> None:
    with pytest.raises(LogError, match="the tool uses no IMU"):
        of(joint_states(SHORT), poses(SHORT), axis="x")


def test_wheels_that_never_move_are_refused() -> None:
    still = usual(plan=[(10, 0, 0)])
    still = Drive(**{**vars(still), "left": still.left * 0, "right": still.right * 0})
    with pytest.raises(LogError, match="neither positions nor velocities that change"):
        of(joint_states(still), imu(still))


def test_messages_of_other_types_are_ignored() -> None:
    other = RosMessage("/camera", "sensor_msgs/msg/Image", "cdr", 1, b"")
    bag = of(joint_states(SHORT), imu(SHORT), iter([other]))
    assert runs(bag).runs
