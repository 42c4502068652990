"""Replacements for rclpy and geometry_msgs, which need ROS, with the parts that `drive.py` uses.

As in the real rclpy, a signal shuts the context down by default, even while a node publishes. The
messages go to a real daemon in the protocol of rmw_zenoh or of a bridge.
"""

from __future__ import annotations

from pathlib import Path

RCLPY = """\
import os
import signal
import zenoh
from rclpy.signals import SignalHandlerOptions
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
        if not valid:
            raise RuntimeError("the publisher's context is invalid")
        payload = twist(message.linear.x, message.angular.z)
        self.client.put(self.topic, TWIST, payload)

class Node:
    def create_publisher(self, kind, topic, depth):
        assert kind.__name__ == "Twist"
        return Publisher(topic)

valid = False

def install(number):
    before = signal.getsignal(number)
    def handler(number, frame):
        global valid
        valid = False
        if callable(before):
            before(number, frame)
    signal.signal(number, handler)

def init(*, args=None, signal_handler_options=None):
    global valid
    valid = True
    options = SignalHandlerOptions.ALL if signal_handler_options is None else signal_handler_options
    if options & SignalHandlerOptions.SIGINT:
        install(signal.SIGINT)
    if options & SignalHandlerOptions.SIGTERM:
        install(signal.SIGTERM)

def create_node(name): return Node()

def shutdown():
    global valid
    if not valid:
        raise RuntimeError("the context was shut down already")
    valid = False

def try_shutdown():
    if valid:
        shutdown()
"""

SIGNALS = """\
from enum import IntFlag

class SignalHandlerOptions(IntFlag):
    NO = 0
    SIGINT = 1
    SIGTERM = 2
    ALL = 3
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
    """Write the replacement packages into the directory `where`."""
    for name, text in {
        "rclpy/__init__.py": RCLPY,
        "rclpy/signals.py": SIGNALS,
        "rclpy/utilities.py": UTILITIES,
        "geometry_msgs/__init__.py": "",
        "geometry_msgs/msg.py": MESSAGES,
    }.items():
        file = where / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
