"""Writes ROS 2 bags of simulated drives with the library rosbags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from tests.unit.calibration.robots import Drive

START_NS = 1_700_000_000_000_000_000
JOINTS = ("wheel_left_joint", "wheel_right_joint")
PERIOD_S = 0.01


def write_bag(directory: Path, drive: Drive, *, sqlite: bool = False) -> Path:
    """Write the wheels, gyro and positions of a drive. This function shares no code with acsard."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types

    def header(at_ns: int) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](*divmod(at_ns, 10**9))
        return types["std_msgs/msg/Header"](stamp, "base_link")

    zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    level = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    nothing = np.zeros(9)
    angles = np.cumsum(np.column_stack((drive.left, drive.right)), axis=0) * PERIOD_S
    rows: list[tuple[int, str, Any]] = []
    for t, both in zip(drive.t, angles, strict=True):
        at_ns = START_NS + round((float(t) + PERIOD_S / 2) * 1e9)
        state = types["sensor_msgs/msg/JointState"](
            header(at_ns), list(JOINTS), both, np.zeros(0), np.zeros(0)
        )
        rows.append((at_ns, "/joint_states", state))
    for t, rate in zip(drive.gyro_t, drive.gyro, strict=True):
        at_ns = START_NS + round(float(t) * 1e9)
        turn = types["geometry_msgs/msg/Vector3"](0.0, 0.0, float(rate))
        sample = types["sensor_msgs/msg/Imu"](
            header(at_ns), level, nothing, turn, nothing, zero, nothing
        )
        rows.append((at_ns, "/imu/data", sample))
    for t, place in zip(drive.place_t, drive.place, strict=True):
        at_ns = START_NS + round(float(t) * 1e9)
        spot = types["geometry_msgs/msg/Point"](place.real, place.imag, 0.0)
        where = types["geometry_msgs/msg/Pose"](spot, level)
        rows.append((at_ns, "/slam/pose", types["geometry_msgs/msg/PoseStamped"](
            header(at_ns), where
        )))  # fmt: skip
    plugin = StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP
    with Writer(directory, version=9, storage_plugin=plugin) as writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, kind in (
                ("/joint_states", "sensor_msgs/msg/JointState"),
                ("/imu/data", "sensor_msgs/msg/Imu"),
                ("/slam/pose", "geometry_msgs/msg/PoseStamped"),
            )
        }
        for at_ns, topic, value in sorted(rows, key=lambda row: row[0]):
            connection = connections[topic]
            writer.write(connection, at_ns, store.serialize_cdr(value, connection.msgtype))
    return directory
