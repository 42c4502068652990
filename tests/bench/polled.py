"""The original driver's method, for comparison: poll, update, write, sleep.

    python -m tests.bench.polled --config FILE --port DEVICE [--drain]

This is a small copy of a ros2_control hardware interface, which reads and writes one line per
cycle. Every cycle reads at most one line from the port and leaves the rest in the buffer, publishes
the odometry, and writes the newest command. With --drain every cycle reads all lines and uses the
newest, which is the obvious improvement of the original.

The program has no safety functions (limits, timeouts, checks), because only the parts that cost
time matter here. It uses acsard's wire format and keys, so the same rig measures both programs.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import time
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import serial
import zenoh

TOKEN = re.compile(rb"[abcd]([pn])(\d+\.\d+)")

RADIUS, SEPARATION = 0.05, 0.30


def line_for(linear: float, angular: float) -> bytes:
    """Return the serial line that sends the wheel speeds of this twist, in m/s and rad/s."""
    right = (linear + angular * SEPARATION / 2) / RADIUS
    left = (linear - angular * SEPARATION / 2) / RADIUS
    wheels = zip("abcd", (right, left, left, right), strict=True)
    tokens = [f"{motor}{'n' if speed < 0 else 'p'}{abs(speed):05.2f}" for motor, speed in wheels]
    return (",".join(tokens) + "\r\n").encode()


class Robot:
    """The robot's pose, its newest command, and the received bytes that are not decoded yet."""

    def __init__(self) -> None:
        self.x = self.y = self.yaw = self.linear = self.angular = 0.0
        self.line = line_for(0.0, 0.0)
        self.buffer = b""

    def on_command(self, sample: zenoh.Sample) -> None:
        """Store the newest command. The main loop writes it at the next tick."""
        message = msgspec.msgpack.decode(sample.payload.to_bytes())
        linear = message.get("linear", {}).get("x", 0.0)
        self.line = line_for(linear, message.get("angular", {}).get("z", 0.0))

    def read(self) -> bool:
        """Decode one line from the buffer. Return whether the buffer contained a whole line."""
        line, end, rest = self.buffer.partition(b"\n")
        if not end:
            return False
        self.buffer = rest
        tokens = TOKEN.findall(line)
        if len(tokens) == 4:
            a, b, c, d = [float(size) * (1 if sign == b"p" else -1) for sign, size in tokens]
            right, left = RADIUS * (a + d) / 2, RADIUS * (b + c) / 2
            self.linear, self.angular = (right + left) / 2, (right - left) / SEPARATION
        return True

    def update(self, dt: float) -> dict[str, object]:
        """Integrate the speeds over `dt` seconds, and return the odometry message."""
        self.x += self.linear * math.cos(self.yaw) * dt
        self.y += self.linear * math.sin(self.yaw) * dt
        self.yaw += self.angular * dt
        sec, nanosec = divmod(time.time_ns(), 1_000_000_000)
        position, turn = {"x": self.x, "y": self.y}, {"z": math.sin(self.yaw / 2)}
        pose = {"position": position, "orientation": turn | {"w": math.cos(self.yaw / 2)}}
        twist = {"linear": {"x": self.linear}, "angular": {"z": self.angular}}
        return {
            "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "odom"},
            "child_frame_id": "base_link",
            "pose": {"pose": pose, "covariance": [0.0] * 36},
            "twist": {"twist": twist, "covariance": [0.0] * 36},
        }


def session_of(config: dict[str, Any]) -> tuple[zenoh.Session, str, str]:
    """Open a Zenoh session. Also return the prefix of its keys and the command source's name."""
    settings = zenoh.Config()
    settings.insert_json5("mode", '"peer"')
    settings.insert_json5("listen/endpoints", json.dumps(config["bus"]["listen"]))
    settings.insert_json5("scouting/multicast/enabled", "false")
    root, source = f"acsard/{config['robot']['id']}", config["commands"]["sources"][0]["name"]
    return zenoh.open(settings), root, source


def main() -> None:
    """Run until the process is killed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--config", type=Path)
    parser.add_argument("--port")
    parser.add_argument("--drain", action="store_true")
    args = parser.parse_args()
    config = tomllib.loads(args.config.read_text())
    robot = Robot()
    with serial.Serial(args.port, config["mcu"]["baud_rate"], timeout=0) as port:
        session, root, source = session_of(config)
        subscriber = session.declare_subscriber(f"{root}/cmd/{source}", robot.on_command)
        odometry = session.declare_publisher(f"{root}/odom")
        period = 1.0 / config["control"]["rate"]
        due = time.monotonic()
        while subscriber:
            robot.buffer += port.read(4096 if args.drain else max(0, 128 - len(robot.buffer)))
            while robot.read() and args.drain:
                pass
            odometry.put(msgspec.msgpack.encode(robot.update(period)))
            port.write(robot.line)
            due += period
            time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main()
