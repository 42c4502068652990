"""The daemon's estimates agree with the true state of the simulated robot, on a real bus."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from tests.system.harness import Bus, Daemon, Peer, running, until


def yaw(pose: Any) -> float:
    turn = pose["orientation"]
    return 2 * math.atan2(turn["z"], turn["w"])


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
