"""ROS 2 bags of simulated drives, as messages and as files that the library rosbags writes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from acsard.calibration.ros_bag_log import TYPES, RosMessage
from acsard.core.messages.encodings import encode
from tests.unit.calibration.robots import RADIUS, SEPARATION, Drive, Floats

START_NS = 1_700_000_000_000_000_000
JOINTS = ("wheel_left_joint", "wheel_right_joint")
NAMES = {cls: name for name, cls in TYPES.items()}
PERIOD_S = 0.01


def message(topic: str, kind: str, at: float, *, came: float | None = None, **fields: object
            ) -> RosMessage:  # fmt: skip
    """Return a message that has the stamp `at` and was recorded at `came`, s since the start."""
    made_ns = START_NS + round(at * 1e9)
    wall_ns = made_ns if came is None else START_NS + round(came * 1e9)
    (cls,) = (cls for cls in NAMES if cls.__name__ == kind)
    stamp = dict(zip(("sec", "nanosec"), divmod(made_ns, 10**9), strict=True))
    decoded = msgspec.convert({"header": {"stamp": stamp}, **fields}, cls)
    return RosMessage(topic, NAMES[cls], "cdr", wall_ns, encode(decoded, "cdr"))


def joint_states(
    drive: Drive, topic: str = "/joint_states", names: Sequence[str] = JOINTS, *,
    speeds: bool = False,
) -> Iterator[RosMessage]:  # fmt: skip
    """Yield the wheels' messages: angles at the end of each period, or speeds in its middle.

    The first half of the joints are on the left.
    """
    half = len(names) // 2
    sides = np.column_stack([drive.left] * half + [drive.right] * half)
    angles = np.cumsum(sides, axis=0) * PERIOD_S
    for t, speed, angle in zip(drive.t, sides, angles, strict=True):
        values = {"velocity": speed.tolist()} if speeds else {"position": angle.tolist()}
        at = float(t) if speeds else float(t) + PERIOD_S / 2
        yield message(topic, "JointState", at, name=list(names), **values)


def imu(drive: Drive, topic: str = "/imu/data", axis: int = 2, sign: float = 1.0, late: float = 0.0
        ) -> Iterator[RosMessage]:  # fmt: skip
    """Yield the messages of a gyro whose `axis` points up (`sign` 1) or down (`sign` -1).

    The gyro's clock is `late` seconds behind.
    """
    none = [0.0] * 9
    noise = np.random.default_rng(0).normal(0.0, 0.01, (len(drive.gyro_t), 3))
    for t, rate, other in zip(drive.gyro_t, drive.gyro, noise.tolist(), strict=True):
        other[axis] = sign * float(rate)
        yield message(
            topic, "Imu", float(t) - late, came=float(t), orientation={},
            orientation_covariance=none, angular_velocity=dict(zip("xyz", other, strict=True)),
            angular_velocity_covariance=none, linear_acceleration={},
            linear_acceleration_covariance=none,
        )  # fmt: skip


def pose(place: complex, yaw: float | None) -> dict[str, object]:
    turn = {"z": 0.0, "w": 0.0} if yaw is None else {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    return {"position": {"x": place.real, "y": place.imag}, "orientation": turn}


def poses(drive: Drive, topic: str = "/slam/pose", *, yaw: bool = False) -> Iterator[RosMessage]:
    """Yield the positions of the drive as `PoseStamped`, with or without the true yaw."""
    for t, place in zip(drive.place_t, drive.place, strict=True):
        turn = float(np.interp(t, drive.t, drive.yaw)) + 0.7 if yaw else None
        yield message(topic, "PoseStamped", float(t), pose=pose(complex(place), turn))


def odometry(
    t: Floats, where: Sequence[complex], yaw: Floats, topic: str = "/odom"
) -> Iterator[RosMessage]:
    none = [0.0] * 36
    for at, place, turn in zip(t, where, yaw, strict=True):
        yield message(
            topic, "Odometry", float(at), child_frame_id="base_link",
            pose={"pose": pose(complex(place), float(turn)), "covariance": none},
            twist={"twist": {"linear": {}, "angular": {}}, "covariance": none},
        )  # fmt: skip


def wheel_odometry(drive: Drive, track: float = 1.4, topic: str = "/odom") -> Iterator[RosMessage]:
    """Yield the odometry that the robot's driver computes from its wheels."""
    turn = (drive.right - drive.left) * RADIUS / (SEPARATION * track) * PERIOD_S
    yaw = np.cumsum(turn)
    ahead = (drive.right + drive.left) / 2 * RADIUS * PERIOD_S
    where = np.cumsum(ahead * np.exp(1j * (yaw - turn / 2)))
    return odometry(drive.t + PERIOD_S / 2, list(where), yaw, topic)


def in_order(*topics: Iterator[RosMessage]) -> list[RosMessage]:
    return sorted((entry for topic in topics for entry in topic), key=lambda entry: entry.wall_ns)


def write_mcap(
    path: Path, messages: Sequence[RosMessage], compression: CompressionType = CompressionType.ZSTD
) -> Path:
    """Write the messages as a bag file with the MCAP library."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1 << 16, compression=compression)
        writer.start("ros2", "libmcap")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for entry in messages:
            if entry.type not in schemas:
                schemas[entry.type] = writer.register_schema(entry.type, "ros2msg", b"")
            if entry.topic not in channels:
                channels[entry.topic] = writer.register_channel(
                    entry.topic, entry.encoding, schemas[entry.type]
                )
            writer.add_message(channels[entry.topic], entry.wall_ns, entry.data, entry.wall_ns)
        writer.finish()
    return path


def write_bag(directory: Path, drive: Drive, *, sqlite: bool = False) -> Path:
    """Write the wheels, gyro and positions of a drive as a bag with the library rosbags.

    This function shares no code with acsard.
    """
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
    with BagWriter(directory, version=9, storage_plugin=plugin) as writer:
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
