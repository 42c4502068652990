"""One drive with known truth, as a ROS 2 bag or as arrays. It uses none of the code under test.

The truth: radius 0.05 m left and 0.0505 m right, wheel separation 0.30 m, effective track 0.45 m.
So the multipliers are 1.500, 1.000 and 1.010 by positions, and by a gyro alone, which does not show
the size of the wheels, 1.4925, 0.9950 and 1.0050.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

Floats = npt.NDArray[np.float64]

RADIUS, SEPARATION, TRACK, RIGHT = 0.05, 0.30, 1.5, 1.01
START = 1_760_000_000.0
PLACES = "front_left", "front_right", "rear_left", "rear_right"
WHEELS = tuple(f"{place}_wheel_joint" for place in PLACES)
LEFT_JOINTS, RIGHT_JOINTS = list(WHEELS[0::2]), list(WHEELS[1::2])
STEP = 0.002
JOINT_HZ, IMU_HZ = 50, 50

SCRIPT = Path(__file__).parents[2] / "deploy" / "calibration" / "bag_to_csv.py"
script = runpy.run_path(str(SCRIPT))


def motion(legs: list[tuple[float, float, float]]) -> dict[str, Floats]:
    """Return the true motion of legs of (s, m/s, rad/s), with the motors' lag of 0.15 s."""
    v, w = (
        np.concatenate([np.full(round(leg[0] / STEP), float(leg[k])) for leg in legs])
        for k in (1, 2)
    )
    for column in (v, w):
        value = 0.0
        for i in range(len(column)):
            value += STEP / 0.15 * (column[i] - value)
            column[i] = value
    yaw = np.cumsum(w) * STEP
    left = (v - w * SEPARATION * TRACK / 2) / RADIUS
    right = (v + w * SEPARATION * TRACK / 2) / (RADIUS * RIGHT)
    return {
        "t": np.arange(len(v)) * STEP, "w": w, "yaw": yaw, "left": left, "right": right,
        "left_angle": np.cumsum(left) * STEP, "right_angle": np.cumsum(right) * STEP,
        "x": np.cumsum(v * np.cos(yaw)) * STEP, "y": np.cumsum(v * np.sin(yaw)) * STEP,
    }  # fmt: skip


def _legs() -> list[tuple[float, float, float]]:
    legs: list[tuple[float, float, float]] = [
        (3, 0, 0), (5, 0.4, 0), (1, 0, 0), (5, -0.4, 0), (1, 0, 0),
    ]  # fmt: skip
    for w in (0.6, 1.2):
        legs += [(3 * np.pi / w, 0, w), (1, 0, 0), (3 * np.pi / w, 0, -w), (1, 0, 0)]
    curves = [(6.0, v, side * w) for v, w in ((0.3, 0.5), (0.4, 0.3)) for side in (1, -1)]
    return [*legs, *curves, (4, 0.3, 0), (1.5, 0, 0)]


DRIVE = motion(_legs())
END = float(DRIVE["t"][-1])


def at(name: str, t: float | Floats) -> Any:
    return np.interp(t, DRIVE["t"], DRIVE[name])


class Bag:
    """Collects messages. `recorded` is the time of recording, `stamp` that in the message, s."""

    def __init__(self) -> None:
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._types = self._store.types
        self._rows: list[tuple[float, str, Any]] = []

    def _header(self, stamp: float, frame: str) -> Any:
        time = self._types["builtin_interfaces/msg/Time"](*divmod(round(stamp * 1e9), 10**9))
        return self._types["std_msgs/msg/Header"](time, frame)

    def _vector(self, kind: str, *values: float) -> Any:
        return self._types[f"geometry_msgs/msg/{kind}"](*map(float, values))

    def joints(
        self, recorded: float, stamp: float, names: tuple[str, ...], angles: list[float],
        speeds: list[float] | None = None,
    ) -> None:  # fmt: skip
        message = self._types["sensor_msgs/msg/JointState"](
            self._header(stamp, ""), list(names), np.array(angles, dtype=float),
            np.array(speeds or [], dtype=float), np.zeros(0),
        )  # fmt: skip
        self._rows.append((recorded, "/joint_states", message))

    def imu(self, recorded: float, stamp: float, rate: float, frame: str = "imu_link") -> None:
        zero, nothing = self._vector("Vector3", 0, 0, 0), np.zeros(9)
        message = self._types["sensor_msgs/msg/Imu"](
            self._header(stamp, frame), self._vector("Quaternion", 0, 0, 0, 1), nothing,
            self._vector("Vector3", 0, 0, rate), nothing, zero, nothing,
        )  # fmt: skip
        self._rows.append((recorded, "/imu/data", message))

    def pose(
        self, recorded: float, stamp: float, place: tuple[float, float, float], yaw: float,
        axis: int = 2,
    ) -> None:  # fmt: skip
        turn = [0.0, 0.0, 0.0, np.cos(yaw / 2)]
        turn[axis] = np.sin(yaw / 2)
        pose = self._types["geometry_msgs/msg/Pose"](
            self._vector("Point", *place), self._vector("Quaternion", *turn)
        )
        message = self._types["geometry_msgs/msg/PoseStamped"](self._header(stamp, "map"), pose)
        self._rows.append((recorded, "/pose", message))

    def write(self, directory: Path, *, sqlite: bool = False) -> Path:
        plugin = StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP
        with Writer(directory, version=9, storage_plugin=plugin) as writer:
            connections: dict[str, Any] = {}
            for recorded, topic, message in sorted(self._rows, key=lambda row: row[0]):
                if topic not in connections:
                    connections[topic] = writer.add_connection(
                        topic, message.__msgtype__, typestore=self._store
                    )
                data = self._store.serialize_cdr(message, message.__msgtype__)
                writer.write(connections[topic], round(recorded * 1e9), data)
        return directory


# Write the messages of one sample: of the wheels (angles, rad), the gyro (rad/s), or the pose.
Joint = Callable[[Bag, int, float, float, float], None]
Gyro = Callable[[Bag, float, float], None]
Pose = Callable[[Bag, float, float, float, float], None]


def usual_joints(bag: Bag, number: int, t: float, left: float, right: float) -> None:
    a, b = at("left", t), at("right", t)
    bag.joints(START + t + 0.002, START + t, WHEELS, [left, right] * 2, [a, b] * 2)


def usual_gyro(bag: Bag, t: float, rate: float) -> None:
    bag.imu(START + t + 0.002, START + t, rate)


def usual_pose(bag: Bag, t: float, x: float, y: float, yaw: float) -> None:
    bag.pose(START + t + 0.002, START + t, (x, y, 0.0), yaw)


def bag(
    joint: Joint = usual_joints, gyro: Gyro | None = usual_gyro, pose: Pose = usual_pose,
    pose_hz: float = 0.0,
) -> Bag:  # fmt: skip
    """Return the drive as a bag; the hooks write the messages themselves."""
    made, rng, count = Bag(), np.random.default_rng(7), 2 * np.pi / 3200
    for number, t in enumerate(np.arange(0, END, 1 / JOINT_HZ)):
        sides = (at(name, t) for name in ("left_angle", "right_angle"))
        joint(made, number, t, *(float(np.floor(side / count) * count) for side in sides))
    for t in np.arange(0, END, 1 / IMU_HZ) if gyro else ():
        assert gyro
        gyro(made, t, at("w", t) + 0.01 + rng.normal(0, 0.004))
    for t in np.arange(0, END, 1 / pose_hz) if pose_hz else ():
        pose(made, t, *(at(name, t) + rng.normal(0, 0.004) for name in ("x", "y", "yaw")))
    return made


def converted(
    bag: Path, *options: str, left: Sequence[str] = LEFT_JOINTS, right: Sequence[str] = RIGHT_JOINTS
) -> bytes:
    """Return the CSV that the script makes of a bag."""
    words = [str(bag), "unused", "--wheels", "/joint_states", "--left", *left]
    args = script["parser"].parse_args([*words, "--right", *right, *options])
    return str(script["convert"](args)).encode()
