#!/usr/bin/env python3
"""Convert a ROS bag to the CSV file that `acsard calibrate log` reads.

It reads bags of ROS 1 and ROS 2 in any storage format, and needs `pip install rosbags`. It is told
the topics and the joints, and guesses neither. What it leaves out or corrects, it says.
"""

import argparse
import sys
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

ODD_S, MOST_ODD = 2.0, 0.05  # from the usual delay of a topic, and the share that may be left out
CLOCK_S, DRIFT, MAX_SPREAD_S = 1.0, 1e-3, 1.0  # of the clock of a topic
ALTERNATIONS, APART_RAD = 10, 0.5  # of two series of angles on one topic
BACK_S = 1.0  # a jump back of the time, which is no change of the order
AXES = "x", "y", "z"
KINDS = {
    "wheels": ["JointState"], "imu": ["Imu"],
    "positions": ["PoseStamped", "PoseWithCovarianceStamped", "Odometry", "TransformStamped"],
}  # fmt: skip

Array = Any  # of numpy
Row = tuple[float, str]  # place in the bag, and the line


def note(text: str) -> None:
    sys.stderr.write(f"note: {text}\n")


class Topic:
    """The messages of one topic: where they are in the bag, their times, and their values."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.frames: set[str] = set()
        self.at: list[int] = []
        self.recorded: list[float] = []
        self.stamps: list[float] = []
        self.messages: list[Any] = []

    def add(self, at: int, recorded_ns: int, message: Any) -> None:
        self.frames.add(message.header.frame_id)
        if len(self.frames) > 1:
            raise SystemExit(
                f"{self.name}: the messages have the frames {' and '.join(sorted(self.frames))}, "
                "so two programs publish this topic: record only one of them"
            )
        stamp = message.header.stamp
        self.at.append(at)
        self.recorded.append(recorded_ns / 1e9)
        self.stamps.append(stamp.sec + stamp.nanosec / 1e9)
        self.messages.append(message)

    @cached_property
    def times(self) -> tuple[Array, Array]:
        """The times of the samples, s, and a mask of the messages to use."""
        recorded, stamps = np.array(self.recorded), np.array(self.stamps)
        delay = recorded - stamps
        usual = float(np.median(delay))
        good = np.abs(delay - usual) < ODD_S
        if float(np.mean(~good)) > MOST_ODD or float(np.ptp(delay[good])) > MAX_SPREAD_S:
            note(f"{self.name}: the stamps do not follow the time, so the times of recording count")
            return recorded, np.ones(len(delay), dtype=bool)
        if not good.all():
            example = self.stamps[int(np.flatnonzero(~good)[0])]
            note(
                f"{self.name}: {np.sum(~good)} messages with a wrong stamp are left out, "
                f"such as {example:.0f} s"
            )
        drift = float(np.polyfit(stamps[good] - stamps[good][0], delay[good], 1)[0])
        if abs(drift) > DRIFT:
            note(
                f"{self.name}: its clock runs {drift:+.1%} beside that of the recording; corrected"
            )
            return stamps + np.polyval(np.polyfit(stamps[good], delay[good], 1), stamps), good
        if abs(usual) > CLOCK_S:
            note(f"{self.name}: its clock is {usual:.0f} s off that of the recording; corrected")
            return stamps + usual, good
        return stamps, good


def wheels(topics: Sequence[Topic], left: Sequence[str], right: Sequence[str]) -> Iterable[Row]:
    """Yield a row with the mean speed of each side, rad/s, for each sample of the first joint."""
    joints = {name: joint(topics, name) for name in (*left, *right)}
    angles = {name: made for name, made in joints.items() if made[2] is not None}
    usable = len(angles) == len(joints)
    speeds = {name: made[3] for name, made in joints.items() if made[3] is not None}
    if usable and all(same(joints[a][2], joints[b][2]) for a in left for b in right):
        if len(speeds) < len(joints) or all(
            same(speeds[a], speeds[b]) for a in left for b in right
        ):
            raise SystemExit("the angles of the left and of the right joints are the same: is one "
                             "side copied to the other?")  # fmt: skip
        note("the angles of the left and the right joints are the same, but their velocities are "
             "not: the driver copies one side, so the velocities count")  # fmt: skip
        usable = False
    if not usable and len(speeds) < len(joints):
        raise SystemExit("not all joints have angles in `position`, or speeds in `velocity`")
    made = {
        name: by_angles(name, at, t, angle) if usable else (at, t, speed)
        for name, (at, t, angle, speed) in joints.items()
    }
    at, t, _ = made[left[0]]
    sides = [np.mean([onto(t, *made[name][1:]) for name in side], axis=0) for side in (left, right)]
    for place, time, a, b in zip(at, t, *sides, strict=True):
        if np.isfinite(a + b):
            yield place, f"{time:.6f},{a:.6f},{b:.6f},,,,"


def joint(topics: Sequence[Topic], name: str) -> tuple[Array, Array, Array, Array]:
    """Return places, times, angles and speeds of a joint. The last two are None if missing."""
    rows = []
    for topic in topics:
        times, good = topic.times
        for at, t, sound, message in zip(topic.at, times, good, topic.messages, strict=True):
            if sound and name in message.name:
                index = list(message.name).index(name)
                values = [v[index] if index < len(v) else np.nan
                          for v in (message.position, message.velocity)]  # fmt: skip
                rows.append((at, t, *values))
    if not rows:
        names = sorted({n for topic in topics for m in topic.messages for n in m.name})
        raise SystemExit(f"there is no joint {name}; the joints are {', '.join(names)}")
    table = np.array(rows)
    table = table[np.isfinite(table[:, 2]) | np.isfinite(table[:, 3])]
    if np.diff(table[:, 1]).min(initial=0.0) > -BACK_S:  # only the network changed the order
        table = table[np.argsort(table[:, 1], kind="stable")]
    at, t, angle, speed = table.T
    return (at, t, angle if np.isfinite(angle).any() else None,
            speed if np.isfinite(speed).all() else None)  # fmt: skip


def by_angles(name: str, at: Array, t: Array, angle: Array) -> tuple[Array, Array, Array]:
    """Return places, times and speeds between the angles of a joint."""
    whole = np.isfinite(angle)
    at, t, angle = at[whole], t[whole], angle[whole]
    turn, step = np.diff(angle), np.diff(t)
    if np.ptp(angle) < 6.3 and np.abs(turn).max() > np.pi:  # wrapped at a turn
        turn = turn - 2 * np.pi * np.round(turn / (2 * np.pi))
    away = np.abs(turn) > APART_RAD
    swaps = away[1:] & away[:-1] & (np.abs(turn[1:] + turn[:-1]) < 0.2 * np.abs(turn[1:]))
    row = np.convolve(swaps, np.ones(ALTERNATIONS), "valid") if len(swaps) > ALTERNATIONS else swaps
    if len(row) and row.max() >= ALTERNATIONS:
        first = t[int(np.argmax(row >= ALTERNATIONS))] - t[0]
        raise SystemExit(
            f"{name}: two series of angles alternate, {first:.0f} s after the start. Either two "
            "programs publish this joint (a joint_state_publisher beside the driver?), or the "
            "computer's clock was set back while it recorded: record again, with the driver alone "
            "and a steady clock"
        )
    good = step > 0
    return at[1:][good], (t[1:] - step / 2)[good], (turn[good] / step[good])


def onto(t: Array, times: Array, values: Array) -> Array:
    """Return the values at the times `t`."""
    if same(t, times):
        return values
    order = np.argsort(times, kind="stable")
    return np.interp(t, times[order], values[order])


def same(a: Array, b: Array) -> bool:
    return len(a) == len(b) and bool(np.allclose(a, b, rtol=0, atol=1e-9, equal_nan=True))


def gyro(topic: Topic, axis: str) -> Iterable[Row]:
    times, good = topic.times
    for at, t, sound, message in zip(topic.at, times, good, topic.messages, strict=True):
        if sound:
            rate = getattr(message.angular_velocity, axis[-1])
            yield at, f"{t:.6f},,,{-rate if axis[0] == '-' else rate:.6f},,,"


def positions(topic: Topic, up: str, *, yaw: bool) -> Iterable[Row]:
    """Yield a row for each pose, in the plane below the axis `up`."""
    times, good = topic.times
    poses = [pose(message) for message in topic.messages]
    places, turns = (np.array([p[n] for p in poses]) for n in range(2))
    axis, sign = AXES.index(up[-1]), -1.0 if up[0] == "-" else 1.0
    first, second = ((axis + 1) % 3, (axis + 2) % 3)[:: int(sign)]
    # The turn about an axis is the twist of the quaternion about it.
    about = [np.unwrap(2 * np.arctan2(turns[:, n], turns[:, 3])) for n in range(3)]
    ranges = [float(np.ptp(angle)) for angle in about]
    most = int(np.argmax(ranges))
    if ranges[axis] < 0.3 and ranges[most] > 1.0:
        raise SystemExit(
            f"{topic.name}: the poses turn about their {AXES[most]} axis and not about {up[-1]}: "
            f"if {AXES[most]} points up, add --up {AXES[most]}"
        )
    for at, t, sound, place, turn in zip(topic.at, times, good, places, about[axis], strict=True):
        if sound:
            heading = f"{sign * turn:.6f}" if yaw else ""
            yield at, f"{t:.6f},,,,{place[first]:.5f},{place[second]:.5f},{heading}"


def pose(message: Any) -> tuple[Sequence[float], Sequence[float]]:
    if hasattr(message, "transform"):
        p, q = message.transform.translation, message.transform.rotation
    else:
        inner = getattr(message.pose, "pose", message.pose)
        p, q = inner.position, inner.orientation
    return (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)


def convert(args: argparse.Namespace) -> str:
    names = {*args.wheels, args.imu, args.positions} - {None}
    topics = {name: Topic(name) for name in names}
    # A recording that was cut off has no metadata.yaml.
    cut_off = args.bag.is_dir() and not (args.bag / "metadata.yaml").exists()
    files = sorted((*args.bag.glob("*.mcap"), *args.bag.glob("*.db3"))) if cut_off else [args.bag]
    with AnyReader(files, default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
        if missing := names - {connection.topic for connection in bag.connections}:
            raise SystemExit(
                f"the bag has no topic {', '.join(sorted(missing))}; its topics are "
                f"{', '.join(sorted({c.topic for c in bag.connections}))}"
            )
        used = [c for c in bag.connections if c.topic in names]
        for option, kinds in KINDS.items():
            given = getattr(args, option)
            for c in used:
                kind = c.msgtype.rpartition("/")[2]
                if c.topic in (given if option == "wheels" else [given]) and kind not in kinds:
                    raise SystemExit(
                        f"{c.topic} is a topic of type {kind}, but --{option} needs "
                        f"{' or '.join(kinds)}"
                    )
        for at, (connection, recorded_ns, data) in enumerate(bag.messages(used)):
            message = bag.deserialize(data, connection.msgtype)
            topics[connection.topic].add(at, recorded_ns, message)
    rows = [*wheels([topics[name] for name in args.wheels], args.left, args.right)]
    if args.imu:
        rows += gyro(topics[args.imu], args.axis)
    if args.positions:
        rows += positions(topics[args.positions], args.up, yaw=args.yaw)
    return "\n".join(["t,left,right,yaw_rate,x,y,yaw", *(line for _, line in sorted(rows))]) + "\n"


AXIS_CHOICES = [*AXES, *(f"-{axis}" for axis in AXES)]
parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("bag", type=Path, help="directory of a ROS 2 bag, or file of a ROS 1 bag")
parser.add_argument("csv", type=Path, help="file to write")
parser.add_argument(
    "--wheels", required=True, nargs="+", metavar="TOPIC", help="JointState of the wheels"
)
parser.add_argument("--left", required=True, nargs="+", metavar="JOINT", help="left wheels")
parser.add_argument("--right", required=True, nargs="+", metavar="JOINT", help="right wheels")
parser.add_argument("--imu", metavar="TOPIC", help="Imu with the turn rate")
parser.add_argument(
    "--axis", default="z", choices=AXIS_CHOICES,
    help="axis of the IMU that points up, such as --axis=-x",
)  # fmt: skip
parser.add_argument(
    "--positions", metavar="TOPIC",
    help="PoseStamped, PoseWithCovarianceStamped, Odometry or TransformStamped",
)  # fmt: skip
parser.add_argument(
    "--up", default="z", choices=AXIS_CHOICES, help="axis of the positions that points up"
)
parser.add_argument("--yaw", action="store_true", help="the positions have a measured heading")
if __name__ == "__main__":
    args = parser.parse_args()
    args.csv.write_text(convert(args))
