"""A real rclpy on Fast DDS, the default middleware of ROS 2, in a process of its own.

The wheels of rclpy are one person's, for x86-64 only, and hold ROS 2 Jazzy's own code. They go into
a venv of their own, because they start each Python of their venv twice.
"""

from __future__ import annotations

import base64
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.system.harness import Program
from tests.system.ros_clients import (
    EMPTY_REQUEST,
    ROUTE_S,
    TRIGGER,
    Called,
    Client,
    Sample,
    Samples,
    bare_environment,
)

WHEELS = (
    "ros-jazzy-rclpy[fastrtps]==7.1.6",
    "ros-jazzy-nav-msgs==5.3.6",
    "ros-jazzy-sensor-msgs==5.3.6",
    "ros-jazzy-std-srvs==5.3.6",
    "ros-jazzy-diagnostic-msgs==5.3.6",
)

CALL_S = 5.0
"""The time after which a service call without an answer is given up."""

PROGRAM = """\
import base64, ctypes, importlib, json, sys, threading, time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

# The wheels lack tf2_msgs. A subscription to raw bytes needs only the name of its type, so another
# type of theirs gets that name in this process.
library = ctypes.CDLL("libgeometry_msgs__rosidl_typesupport_fastrtps_c.so")
support = getattr(library, "rosidl_typesupport_fastrtps_c__get_message_type_support_handle"
                           "__geometry_msgs__msg__TransformStamped")
support.restype = ctypes.POINTER(ctypes.c_void_p)
renamed = ctypes.cast(support()[1], ctypes.POINTER(ctypes.c_char_p))
renamed[0], renamed[1] = b"tf2_msgs::msg", b"TFMessage"

def found(type_name):
    if type_name == "tf2_msgs/msg/TFMessage":
        type_name = "geometry_msgs/msg/TransformStamped"
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)

def text(payload):
    return base64.b64encode(payload).decode()

def quality(depth=10, late=False, best_effort=False):
    return QoSProfile(
        depth=depth,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if late else DurabilityPolicy.VOLATILE,
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE)

lock = threading.Lock()
def say(*words):
    with lock:
        print(*words, flush=True)

rclpy.init()
node = rclpy.create_node("tester")
executor = SingleThreadedExecutor()
executor.add_node(node)
threading.Thread(target=executor.spin, daemon=True).start()
subscriptions, publishers, clients = {}, {}, {}

def follow(key, topic, type_name, **qos):
    subscriptions[key] = node.create_subscription(
        found(type_name), topic, lambda raw: say("sample", key, time.monotonic(), text(raw)),
        quality(**qos), raw=True)

def unfollow(key):
    node.destroy_subscription(subscriptions.pop(key))

def put(topic, type_name, payload, seconds, **qos):
    key = topic, type_name, *qos
    if key not in publishers:
        publishers[key] = node.create_publisher(found(type_name), topic, quality(**qos))
        end = time.monotonic() + seconds
        while not publishers[key].get_subscription_count():
            if time.monotonic() > end:
                return False
            time.sleep(0.01)
        # The bridge's reader may notice the publisher a second later, and lose what comes before.
        time.sleep(1.5)
    publishers[key].publish(base64.b64decode(payload))
    return True

def topic_pub(topic, type_name, rate, times):
    # As `ros2 topic pub -r RATE -t TIMES` does: a new publisher, which waits for one subscription.
    publisher = node.create_publisher(found(type_name), topic, quality())
    while not publisher.get_subscription_count():
        time.sleep(0.1)
    for _ in range(times):
        publisher.publish(found(type_name)())
        time.sleep(1 / rate)
    node.destroy_publisher(publisher)

def call(service, type_name, payload, seconds, available):
    kind = found(type_name)
    if service not in clients:
        clients[service] = node.create_client(kind, service)
    listed = clients[service].wait_for_service(available)
    answered = threading.Event()
    future = clients[service].call_async(
        deserialize_message(base64.b64decode(payload), kind.Request))
    future.add_done_callback(lambda _: answered.set())
    done = answered.wait(seconds)
    return {"listed": listed, "reply": text(serialize_message(future.result())) if done else None}

say("ready")
verbs = {f.__name__: f for f in (follow, unfollow, put, topic_pub, call)}
for line in sys.stdin:
    number, verb, args, kwargs = json.loads(line)
    try:
        answer = verbs[verb](*args, **kwargs)
    except Exception as error:
        answer = {"error": repr(error)}
    say("answer", number, json.dumps(answer))
"""
"""Executes commands from standard input with rclpy, one JSON list per line."""


def python_with_rclpy(cache: Path) -> str:
    """Return a Python that has rclpy. The first call installs the wheels."""
    where = cache / f"rclpy-{sys.version_info.major}.{sys.version_info.minor}"
    python = str(where / "bin/python")
    if not (where / "complete").exists():
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(where)], check=True)
        words = [python, "-m", "pip", "install", "--quiet", *WHEELS]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            pytest.fail(
                "nothing was tried with Fast DDS: the wheels of rclpy cannot be installed (x86-64, "
                f"Python 3.11 to 3.13): {done.stderr}"
            )
        (where / "complete").touch()
    return python


def ros_environment(domain: int, where: Path) -> dict[str, str]:
    """Return the environment of a program of rclpy on Fast DDS."""
    return bare_environment() | {
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(where / "ros-log"),
    }


class _Output(list[str]):
    """The output of the process, which passes each sample on at once."""

    def __init__(self) -> None:
        super().__init__()
        self.following: dict[str, Samples] = {}

    def append(self, line: str) -> None:
        word, key, *rest = line.split(" ", 3) if line.startswith("sample ") else (line, "")
        if word != "sample":
            super().append(line)
        elif key in self.following:
            at, payload = rest
            sample = Sample(float(at), key, base64.b64decode(payload), b"", "")
            self.following[key].take(sample)


class FastDdsNode(Client):
    """A ROS node of rclpy on Fast DDS, in the DDS domain with this number."""

    PAUSE_S = 0.05

    def __init__(self, python: str, domain: int, where: Path) -> None:
        super().__init__()
        words, env = [python, "-c", PROGRAM], ros_environment(domain, where)
        self.program = Program(words, where, env, stdin=subprocess.PIPE)
        self.program.out = self._output = _Output()
        self._number = 0

    def __enter__(self) -> FastDdsNode:
        self.program.__enter__()
        self.program.says("ready")
        return self

    def __exit__(self, *error: object) -> None:
        stdin = self.program.process.stdin
        assert stdin is not None
        stdin.close()
        self.program.__exit__(*error)

    def do(self, verb: str, *args: object, **kwargs: object) -> Any:
        """Call a function of the program in the process, and return its result."""
        self._number += 1
        stdin = self.program.process.stdin
        assert stdin is not None
        stdin.write(json.dumps([self._number, verb, args, kwargs]).encode() + b"\n")
        stdin.flush()
        answer = json.loads(self.program.says(f"answer {self._number} ").split(" ", 2)[2])
        assert not isinstance(answer, dict) or "error" not in answer, answer
        return answer

    def put(self, name: str, type_name: str, payload: bytes, **qos: object) -> None:
        sent = self.do("put", f"/{name}", type_name, _text(payload), ROUTE_S, **qos)
        assert sent, f"no subscription to {name}"

    @contextmanager
    def follow(self, name: str, type_name: str) -> Iterator[Samples]:
        with self._follow(name, type_name, depth=100) as samples:
            yield samples

    @contextmanager
    def follow_late(self, name: str, type_name: str, depth: int = 100) -> Iterator[Samples]:
        with self._follow(name, type_name, depth=depth, late=True) as samples:
            yield samples

    @contextmanager
    def _follow(self, name: str, type_name: str, **qos: object) -> Iterator[Samples]:
        key = f"{name}#{self._number}"
        self._output.following[key] = samples = Samples()
        self.do("follow", key, f"/{name}", type_name, **qos)
        try:
            yield samples
        finally:
            self.do("unfollow", key)
            del self._output.following[key]

    def call(self, name: str, type_name: str = TRIGGER, payload: bytes = EMPTY_REQUEST) -> Called:
        begun = time.monotonic()
        answer = self.do("call", f"/{name}", type_name, _text(payload), CALL_S, ROUTE_S)
        assert answer["listed"], f"{name} is not available"
        now, reply = time.monotonic(), answer["reply"]
        replies = [] if reply is None else [Sample(now, name, base64.b64decode(reply), b"", "")]
        return Called(replies, 0, now - begun)


def _text(payload: bytes) -> str:
    return base64.b64encode(payload).decode()
