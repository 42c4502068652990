"""Stand-ins for rclpy and geometry_msgs, which come with ROS only: what `drive.py` needs of them.

The messages go by the protocol of rmw_zenoh, or as a bridge puts them, into a real daemon.
"""

from __future__ import annotations

from pathlib import Path

RCLPY = """\
import os
import zenoh
from tests.system.harness import client_config
from tests.system.ros_clients import TWIST, BridgeHalf, RmwClient, twist

class Publisher:
    def __init__(self, topic):
        self.session = zenoh.open(client_config(os.environ["ENDPOINT"]))
        self.client = {"rmw": RmwClient, "bridge": BridgeHalf}[os.environ["WAY"]](self.session)
        self.topic = topic
        self.matching = self.session.declare_publisher(self.client.key(self.topic, TWIST))

    def get_subscription_count(self):
        return int(self.matching.matching_status.matching)

    def publish(self, message):
        payload = twist(message.linear.x, message.angular.z)
        self.client.put(self.topic, TWIST, payload)

class Node:
    def create_publisher(self, kind, topic, depth):
        assert kind.__name__ == "Twist"
        return Publisher(topic)

def init(args=None): ...
def create_node(name): return Node()
def shutdown(): ...
"""

UTILITIES = """\
def remove_ros_args(args):
    return args[: args.index("--ros-args")] if "--ros-args" in args else args
"""

MESSAGES = """\
from types import SimpleNamespace

class Twist:
    def __init__(self):
        self.linear = SimpleNamespace(x=0.0, y=0.0, z=0.0)
        self.angular = SimpleNamespace(x=0.0, y=0.0, z=0.0)
"""


def write(where: Path) -> None:
    """Lay the packages there."""
    for name, text in {
        "rclpy/__init__.py": RCLPY,
        "rclpy/utilities.py": UTILITIES,
        "geometry_msgs/__init__.py": "",
        "geometry_msgs/msg.py": MESSAGES,
    }.items():
        file = where / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
