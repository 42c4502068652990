"""Convert a ROS bag to the CSV file that `acsard calibrate --log` reads.

It reads bags of ROS 1 and ROS 2 in any storage format, and needs `pip install rosbags`.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore


def rows(args: argparse.Namespace) -> Iterator[str]:
    """Yield the rows of the table, without line breaks."""
    before, left, right = 0.0, 0.0, 0.0
    wanted = {args.wheels, args.imu, args.positions} - {None}
    with AnyReader([args.bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
        if missing := wanted - {connection.topic for connection in bag.connections}:
            raise SystemExit(f"the bag has no topic {', '.join(missing)}")
        for connection, _, data in bag.messages([c for c in bag.connections if c.topic in wanted]):
            message: Any = bag.deserialize(data, connection.msgtype)
            t = message.header.stamp.sec + message.header.stamp.nanosec / 1e9
            if connection.topic == args.wheels:
                angles, start = list(message.position), (before, left, right)
                values = dict(zip(message.name, angles or message.velocity, strict=True))
                left, right = (
                    sum(values[joint] for joint in side) / len(side)
                    for side in (args.left, args.right)
                )
                before = t
                if not angles:
                    yield f"{t:.6f},{left:.6f},{right:.6f},,,,"
                elif start[0] and (step := t - start[0]) > 0:
                    speeds = f"{(left - start[1]) / step:.6f},{(right - start[2]) / step:.6f}"
                    yield f"{t - step / 2:.6f},{speeds},,,,"
            elif connection.topic == args.imu:
                rate = getattr(message.angular_velocity, args.axis[-1])
                yield f"{t:.6f},,,{-rate if args.axis[0] == '-' else rate:.6f},,,"
            else:
                pose = getattr(message.pose, "pose", message.pose)
                at, q = pose.position, pose.orientation
                yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
                yield f"{t:.6f},,,,{at.x:.4f},{at.y:.4f},{f'{yaw:.6f}' if args.yaw else ''}"


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("bag", type=Path, help="directory of a ROS 2 bag, or file of a ROS 1 bag")
parser.add_argument("csv", type=Path, help="file to write")
parser.add_argument("--wheels", required=True, metavar="TOPIC", help="JointState of the wheels")
parser.add_argument("--left", required=True, nargs="+", metavar="JOINT", help="left wheels")
parser.add_argument("--right", required=True, nargs="+", metavar="JOINT", help="right wheels")
parser.add_argument("--imu", metavar="TOPIC", help="Imu with the turn rate")
parser.add_argument("--axis", default="z", help="axis of the IMU that points up, such as --axis=-x")
parser.add_argument("--positions", metavar="TOPIC", help="PoseStamped or Odometry")
parser.add_argument("--yaw", action="store_true", help="the positions have a measured heading")
if __name__ == "__main__":
    args = parser.parse_args()
    text = "\n".join(["t,left,right,yaw_rate,x,y,yaw", *rows(args)])
    args.csv.write_text(f"{text}\n")
