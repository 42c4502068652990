"""The daemon's estimates agree with the true state of the simulated robot, on a real bus."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from acsard.core.messages.encodings import encode
from acsard.core.messages.schema import Header, Imu, Quaternion, Vector3
from acsard.core.ros.attachments import Attachment
from acsard.core.ros.names import rmw_key
from tests.system.harness import Bus, Daemon, Peer, running, until

SKIDDING: dict[str, dict[str, object]] = {"sim": {"track_multiplier": 1.6}}


@pytest.fixture(scope="module")
def skidding(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bus]:
    """Provide a client of a daemon whose simulated robot turns less than its wheels suggest."""
    where = tmp_path_factory.mktemp("skidding")
    with running(where, config=SKIDDING) as (_, bus):
        yield bus


def yaw(pose: Any) -> float:
    turn = pose["orientation"]
    return 2 * math.atan2(turn["z"], turn["w"])


@pytest.mark.slow
def test_the_true_pose_differs_from_odometry_by_the_simulated_track_multiplier(
    skidding: Bus,
) -> None:
    with skidding.commanding(0.0, 1.0):
        until(lambda: skidding.state()["yaw"] > 1.6, 10.0, "most of a quarter turn")
    skidding.at_rest()
    believed = yaw(skidding.get("odom")["pose"]["pose"])
    assert yaw(skidding.get("sim/pose")["pose"]) == pytest.approx(believed / 1.6, rel=0.02)


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bus]:
    """Provide a client of a daemon on a pty that uses a gyro from the bus."""
    where, tables = tmp_path_factory.mktemp("real"), {"odometry": {"gyro": True}}
    with (
        Peer(where / "mcu") as peer,
        Daemon(where, port=peer.path, config=tables) as daemon,
        Bus(daemon.endpoint) as bus,
    ):
        bus.linked()
        yield bus


# the gyro


@pytest.mark.slow
def test_the_simulated_gyro_corrects_the_odometry_and_is_published_as_imu(tmp_path: Path) -> None:
    tables: dict[str, dict[str, object]] = {"odometry": {"gyro": True}}
    tables["sim"] = {"track_multiplier": 1.6}
    with Daemon(tmp_path, config=tables) as daemon, Bus(daemon.endpoint) as bus:
        until(lambda: bus.state()["gyro"] == "waiting for turn", 10.0, "the gyro knows its bias")
        # Until the gyro is proven, the wheels count, which turn the robot less than they say.
        with bus.follow("imu") as samples, bus.commanding(0.0, 1.0):
            until(lambda: bus.state()["gyro"] == "used", 10.0, "the gyro is used")
        bus.at_rest()
        believed, true = yaw(bus.get("odom")["pose"]["pose"]), yaw(bus.get("sim/pose")["pose"])
        with bus.commanding(0.0, 1.0):
            until(lambda: bus.state()["yaw"] > believed + 1.0, 10.0, "a turn")
        bus.at_rest()
        turned = yaw(bus.get("sim/pose")["pose"]) - true
        assert yaw(bus.get("odom")["pose"]["pose"]) - believed == pytest.approx(turned, rel=0.03)
        assert samples.seen[0].encoding == "application/msgpack;acsard.Imu.v1"


TURNING = {"angular_velocity": {"z": 0.0}}


@pytest.mark.slow
def test_a_gyro_on_the_bus_is_used_and_its_invalid_samples_are_counted(
    tmp_path: Path, peer: Peer
) -> None:
    tables: dict[str, dict[str, object]] = {"odometry": {"gyro": True}}
    with running(tmp_path, port=peer.path, config=tables) as (daemon, bus):
        assert bus.state()["gyro"] == "silent"

        def used() -> bool:
            bus.put("imu", TURNING)
            return bool(bus.state()["gyro"] == "waiting for turn")

        until(used, 20.0, "the gyro is used")

        def refused(value: object, reason: str) -> bool:
            bus.put("imu", value)  # the bus accepts at most one per millisecond
            return bus.count(f"imu_{reason}") > 0

        for value, reason in (
            ({"angular_velocity": {"z": 51.0}}, "out_of_range"),
            ({"linear_acceleration": {"z": 9.8}}, "wrong_shape"),
        ):
            until(lambda: refused(value, reason), 5.0, f"{reason} is counted")  # noqa: B023
        assert [e for e in daemon.events("imu_refused") if e["level"] == "warning"]


def test_a_ros_imu_is_received_on_either_transport(real: Bus) -> None:
    sample = Imu(
        Header(), Quaternion(), [0.0] * 9, Vector3(z=51.0), [0.0] * 9, Vector3(), [0.0] * 9
    )
    rmw = rmw_key(0, "/imu/data", "sensor_msgs/msg/Imu")
    attachment = Attachment(1, 10**18, bytes(range(16))).pack()
    real.session.put("imu/data", encode(sample, "cdr"))
    until(lambda: real.count("imu_out_of_range") == 1, 5.0, "the bridge's sample is received")
    real.session.put(rmw, encode(sample, "cdr"), attachment=attachment)
    until(lambda: real.count("imu_out_of_range") == 2, 5.0, "rmw_zenoh's sample is received")
