"""ROS 2 clients over Zenoh, as rmw_zenoh and as zenoh-bridge-ros2dds.

This module imports nothing of acsard. It has separate code for keys, tokens and attachments, and
rosbags encodes and decodes CDR. The programs run in separate processes.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xxhash
import zenoh
import zenoh.ext
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.promised import TRIGGERS
from tests.system.harness import (
    ROOT,
    Bus,
    Daemon,
    Program,
    Tables,
    client_config,
    environment,
    free_endpoint,
    repeated,
    until,
)
from tests.system.strangers import ROUTER, command_line

TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
ODOMETRY, TF = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
JOINTS, DIAGNOSTICS = "sensor_msgs/msg/JointState", "diagnostic_msgs/msg/DiagnosticArray"
BATTERY = "sensor_msgs/msg/BatteryState"
TRIGGER = "std_srvs/srv/Trigger"
SPEED_LIMIT = "nav2_msgs/msg/SpeedLimit"
EMPTY = "std_msgs/msg/Empty"
LIST, GET = "rcl_interfaces/srv/ListParameters", "rcl_interfaces/srv/GetParameters"

HASHES = {
    TWIST: "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    STAMPED: "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
    ODOMETRY: "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    TF: "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    SPEED_LIMIT: "83d8e4e842559f4d9a988b19d31b162216ec738536389f98438d1a166f91845a",
    EMPTY: "20b625256f32d5dbc0d04fee44f43c41e51c70d3502f84b4a08e7a9c26a96312",
    JOINTS: "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    DIAGNOSTICS: "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    BATTERY: "4bee5dfce981c98faa6828b868307a0a73f992ed0789f374ee96c8f840e69741",
    TRIGGER: "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    LIST: "3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d",
    GET: "bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc",
    "rcl_interfaces/srv/DescribeParameters": (
        "845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e91e4cff"
    ),
    "rcl_interfaces/srv/GetParameterTypes": (
        "da199c878688b3e530bdfe3ca8f74cb9fa0c303101e980a9e8f260e25e1c80ca"
    ),
    "rcl_interfaces/srv/SetParameters": (
        "56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0"
    ),
    "rcl_interfaces/srv/SetParametersAtomically": (
        "0e192ef259c07fc3c07a13191d27002222e65e00ccec653ca05e856f79285fcd"
    ),
}

PUBLISHED = {
    "odom": (ODOMETRY, 10, False),
    "tf": (TF, 100, False),
    "tf_static": (TF, 1, True),
    "joint_states": (JOINTS, 10, False),
    "diagnostics": (DIAGNOSTICS, 10, False),
    "battery_state": (BATTERY, 10, False),
    "cmd_vel_out": (STAMPED, 10, False),
}
"""The robot's publications: type, depth, transient local."""

TWISTS = ("cmd_vel", "cmd_vel_dock", "cmd_vel_teleop")
"""The topics that take both types of twists."""

SUBSCRIBED = {"joint_commands": JOINTS, "speed_limit": SPEED_LIMIT, "stop_request": EMPTY}
"""The robot's subscriptions with one type, which are announced over both transports."""

PARAMETER_SERVICES = {
    "describe_parameters": "rcl_interfaces/srv/DescribeParameters",
    "get_parameter_types": "rcl_interfaces/srv/GetParameterTypes",
    "get_parameters": GET,
    "list_parameters": LIST,
    "set_parameters": "rcl_interfaces/srv/SetParameters",
    "set_parameters_atomically": "rcl_interfaces/srv/SetParametersAtomically",
}

SERVICES = {
    **{f"acsard/{verb}": TRIGGER for verb in TRIGGERS},
    **{f"acsard/{name}": kind for name, kind in PARAMETER_SERVICES.items()},
}

WHEELS = [f"{where}_wheel_joint" for where in ("front_right", "front_left", "rear_left")]
WHEELS.append("rear_right_wheel_joint")


BRIDGE_FILE = ROOT / "deploy/ros2/zenoh-bridge-ros2dds.json5"
"""The configuration of the bridge."""

ROUTE_S = 5.0
"""The longest time in which a bridge has made a route for a new publisher or client.

The bridge reads the nodes of its domain ten times a second.
"""

QUICK: Tables = {
    "limits": {
        "linear_acceleration": 5.0,
        "linear_deceleration": 5.0,
        "linear_stop_deceleration": 5.0,
    },
    "sim": {"faults": ["battery=80:600"]},
}
"""Limits under which a driving test is short, and a board that reports its battery."""


# messages, by rosbags

_store: Any = get_typestore(Stores.ROS2_JAZZY)
for _name, _text in {
    SPEED_LIMIT: "std_msgs/Header header\nbool percentage\nfloat64 speed_limit",
    "std_srvs/msg/TriggerReply": "bool success\nstring message",
    "rcl_interfaces/msg/ListRequest": "string[] prefixes\nuint64 depth",
    "rcl_interfaces/msg/ListReply": "rcl_interfaces/ListParametersResult result",
    "rcl_interfaces/msg/GetRequest": "string[] names",
    "rcl_interfaces/msg/GetReply": "rcl_interfaces/ParameterValue[] values",
    "rcl_interfaces/msg/DescribeReply": "rcl_interfaces/ParameterDescriptor[] descriptors",
    "rcl_interfaces/msg/GetTypesReply": "uint8[] types",
    "rcl_interfaces/msg/SetRequest": "rcl_interfaces/Parameter[] parameters",
    "rcl_interfaces/msg/SetReply": "rcl_interfaces/SetParametersResult[] results",
    "rcl_interfaces/msg/SetAtomicallyReply": "rcl_interfaces/SetParametersResult result",
}.items():
    _store.register(get_types_from_msg(_text, _name))

REQUESTS = {
    TRIGGER: ("std_msgs/msg/Empty", "std_srvs/msg/TriggerReply"),
    LIST: ("rcl_interfaces/msg/ListRequest", "rcl_interfaces/msg/ListReply"),
    GET: ("rcl_interfaces/msg/GetRequest", "rcl_interfaces/msg/GetReply"),
    "rcl_interfaces/srv/DescribeParameters": (
        "rcl_interfaces/msg/GetRequest", "rcl_interfaces/msg/DescribeReply",
    ),
    "rcl_interfaces/srv/GetParameterTypes": (
        "rcl_interfaces/msg/GetRequest", "rcl_interfaces/msg/GetTypesReply",
    ),
    "rcl_interfaces/srv/SetParameters": (
        "rcl_interfaces/msg/SetRequest", "rcl_interfaces/msg/SetReply",
    ),
    "rcl_interfaces/srv/SetParametersAtomically": (
        "rcl_interfaces/msg/SetRequest", "rcl_interfaces/msg/SetAtomicallyReply",
    ),
}  # fmt: skip
"""The messages of each service: its request and its reply."""


def fields_of(type_name: str) -> list[tuple[str, Any]]:
    """Return the fields of a message: the name, and rosbags' description of the type."""
    fields: list[tuple[str, Any]] = _store.fielddefs[type_name][1]
    return fields


def make(type_name: str, **fields: Any) -> Any:
    """Make a message of rosbags."""
    return _store.types[type_name](**fields)


def encode(message: Any) -> bytes:
    """Encode as CDR by rosbags, little endian."""
    return bytes(_store.serialize_cdr(message, message.__msgtype__))


def decode(type_name: str, payload: bytes) -> Any:
    """Decode a message of rosbags from CDR."""
    return _store.deserialize_cdr(payload, type_name)


def header(age: float | None = None, frame: str = "") -> Any:
    """Return a header stamped `age` seconds ago, or without a stamp if `age` is None."""
    sec, nanosec = (0, 0) if age is None else divmod(int((time.time() - age) * 1e9), 10**9)
    stamp = make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def _twist(linear: float, angular: float) -> Any:
    return make(
        TWIST,
        linear=make("geometry_msgs/msg/Vector3", x=linear, y=0.0, z=0.0),
        angular=make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=angular),
    )


def twist(linear: float, angular: float = 0.0) -> bytes:
    """Return a Twist in CDR."""
    return encode(_twist(linear, angular))


def stamped(linear: float, angular: float = 0.0, age: float | None = 0.0) -> bytes:
    """Return a TwistStamped in CDR."""
    return encode(make(STAMPED, header=header(age, "base_link"), twist=_twist(linear, angular)))


def joints(speed: float, names: Sequence[str] = WHEELS) -> bytes:
    """Return a JointState in CDR with velocities only, like ros2_control's topic-based hardware."""
    return encode(
        make(
            JOINTS,
            header=header(0.0),
            name=list(names),
            position=_floats(),
            velocity=_floats(*[speed] * len(names)),
            effort=_floats(),
        )
    )


def _floats(*values: float) -> Any:
    return np.array(values, dtype=np.float64)


PAYLOADS: dict[str, Callable[[float], bytes]] = {TWIST: twist, STAMPED: stamped, JOINTS: joints}
"""How each type requests a speed."""

EMPTY_REQUEST = b"\0\1\0\0\0"
"""A message or a request without fields."""


# names on the wire


def dds_name(type_name: str) -> str:
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def rmw_key(name: str, type_name: str, domain: int = 0) -> str:
    """Return the Zenoh key that rmw_zenoh uses for this ROS name, given without its first slash."""
    return f"{domain}/{name}/{dds_name(type_name)}/RIHS01_{HASHES[type_name]}"


def gid_of(token: str) -> bytes:
    """Return rmw_zenoh's GID: the 128-bit hash of a liveliness token.

    The low half comes first, and both halves are little endian.
    """
    value = xxhash.xxh3_128_intdigest(token.encode())
    return struct.pack("<QQ", value & (2**64 - 1), value >> 64)


class Attached(NamedTuple):
    """The attachment that rmw_zenoh adds to each sample."""

    sequence: int
    stamp_ns: int
    gid: bytes

    def pack(self) -> bytes:
        return struct.pack("<qqB", self.sequence, self.stamp_ns, len(self.gid)) + self.gid

    @classmethod
    def read(cls, data: bytes) -> Attached:
        """Read the attachment, which must have 33 bytes."""
        assert len(data) == 33, data.hex()
        sequence, stamp_ns, length = struct.unpack_from("<qqB", data)
        assert length == 16, data.hex()
        return cls(sequence, stamp_ns, data[17:])


class Sample(NamedTuple):
    """A sample as it arrived, and the time of arrival."""

    at: float
    key: str
    payload: bytes
    attachment: bytes
    origin: str
    """The clock id of the session that put the sample."""


class Samples:
    """Collects the samples that arrive at a subscriber."""

    def __init__(self) -> None:
        self.seen: list[Sample] = []
        self._news = threading.Condition()

    def add(self, sample: zenoh.Sample) -> None:
        """Store a sample. Zenoh calls this function."""
        attachment, stamp = sample.attachment, sample.timestamp
        self.take(
            Sample(
                time.monotonic(),
                str(sample.key_expr),
                sample.payload.to_bytes(),
                b"" if attachment is None else attachment.to_bytes(),
                "" if stamp is None else str(stamp.get_id()),
            )
        )

    def take(self, sample: Sample) -> None:
        with self._news:
            self.seen.append(sample)
            self._news.notify_all()

    def first(
        self, what: str, wanted: Callable[[Sample], bool] = lambda _: True, within: float = 5.0
    ) -> Sample:
        """Return the first sample that is `wanted`."""
        deadline, looked = time.monotonic() + within, 0
        with self._news:
            while True:
                for sample in self.seen[looked:]:
                    if wanted(sample):
                        return sample
                looked = len(self.seen)
                left = deadline - time.monotonic()
                if left <= 0 or not self._news.wait(left):
                    raise AssertionError(f"not within {within:g} s: {what}; {looked} others came")

    def has(self, count: int, within: float = 5.0) -> None:
        """Wait for this total number of samples."""
        until(lambda: len(self.seen) >= count, within, f"{count} samples")


class Called(NamedTuple):
    """The replies to a service call."""

    replies: list[Sample]
    errors: int
    seconds: float

    def trigger(self) -> tuple[bool, str]:
        """Return success and message of the single reply, which must be that of a Trigger."""
        assert len(self.replies) == 1, self
        assert self.errors == 0, self
        reply = decode("std_srvs/msg/TriggerReply", self.replies[0].payload)
        return reply.success, reply.message


def released(ros: Client) -> None:
    """Call `clear` until the daemon executes it.

    A ROS `Trigger` request cannot contain the number of the latch. For 2 s after a stop, the daemon
    refuses a `clear` without this number, because its sender may not have seen the stop.
    """
    until(lambda: ros.call("acsard/clear").trigger()[0], 5.0, "a plain clear is obeyed")


# clients


class Client(ABC):
    """A ROS node that publishes, subscribes and calls services.

    `namespace` is the prefix of every name. Payloads are messages in CDR.
    """

    PAUSE_S = 0.0
    """The time from one message of `publish_until_accepted` to the next, in which the daemon counts
    it."""

    def __init__(self, namespace: str = "") -> None:
        self.namespace = namespace

    def full(self, name: str) -> str:
        return f"{self.namespace}/{name}" if self.namespace else name

    @abstractmethod
    def put(self, name: str, type_name: str, payload: bytes) -> None:
        """Publish a message."""

    @abstractmethod
    def call(self, name: str, type_name: str = TRIGGER, payload: bytes = EMPTY_REQUEST) -> Called:
        """Call a service and wait for its reply."""

    @abstractmethod
    def follow(self, name: str, type_name: str) -> AbstractContextManager[Samples]:
        """Subscribe to a topic while the body runs."""

    @abstractmethod
    def follow_late(
        self, name: str, type_name: str, depth: int = 100
    ) -> AbstractContextManager[Samples]:
        """Subscribe as transient local, which includes earlier samples."""

    def publish_until_accepted(
        self, bus: Bus, name: str, type_name: str, payload: bytes | Callable[[], bytes]
    ) -> None:
        """Publish a command repeatedly until the daemon accepts one.

        If `payload` is a function, it builds each command anew. The daemon accepts a new sender
        only after some messages, when its delays are proved.
        """
        before, sent = bus.count("commands"), 0.0

        def taken() -> bool:
            nonlocal sent
            if time.monotonic() >= sent + self.PAUSE_S:
                self.put(name, type_name, payload if isinstance(payload, bytes) else payload())
                sent = time.monotonic()
            return bus.count("commands") > before

        until(taken, 5.0, f"a command on {name}")

    def zeros(self, bus: Bus) -> None:
        """Publish zeros on every source until the daemon accepts them. This arms each source."""
        for name in TWISTS:
            self.publish_until_accepted(bus, name, TWIST, twist(0.0))
        self.publish_until_accepted(bus, "joint_commands", JOINTS, lambda: joints(0.0))

    @contextmanager
    def driving(self, bus: Bus, name: str, type_name: str, speed: float) -> Iterator[None]:
        """Send a zero first, and then this speed at 20 Hz while the body runs."""
        self.publish_until_accepted(bus, name, type_name, lambda: PAYLOADS[type_name](0.0))
        # No speed may follow a zero of the source `nav` for a second, nor one of a bridge, behind
        # which all nodes are one sender.
        time.sleep(1.1)
        with repeated(lambda: self.put(name, type_name, PAYLOADS[type_name](speed))):
            yield


class ZenohClient(Client):
    """The common part of both kinds of clients, which use an ordinary Zenoh session."""

    def __init__(self, session: zenoh.Session, namespace: str = "") -> None:
        super().__init__(namespace)
        self.session = session

    @abstractmethod
    def key(self, name: str, type_name: str) -> str:
        """Return the key of a topic or a service."""

    @abstractmethod
    def attachment(self) -> bytes | None:
        """Return the attachment of the next sample, or None for a sample without one."""

    def put(self, name: str, type_name: str, payload: bytes) -> None:
        self.session.put(self.key(name, type_name), payload, attachment=self.attachment())

    @contextmanager
    def follow(self, name: str, type_name: str) -> Iterator[Samples]:
        samples = Samples()
        subscriber = self.session.declare_subscriber(self.key(name, type_name), samples.add)
        try:
            yield samples
        finally:
            subscriber.undeclare()

    @contextmanager
    def follow_late(self, name: str, type_name: str, depth: int = 100) -> Iterator[Samples]:
        samples = Samples()
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self.session,
            self.key(name, type_name),
            samples.add,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=depth),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
            subscriber_detection=True,
        )
        try:
            yield samples
        finally:
            subscriber.undeclare()

    def _query(self, key: str, payload: bytes, attachment: bytes | None, **how: Any) -> Called:
        replies, errors, begun = [], 0, time.monotonic()
        for reply in self.session.get(
            key, payload=payload, attachment=attachment, timeout=5.0, **how
        ):
            if reply.ok is None:
                errors += 1
                continue
            samples = Samples()
            samples.add(reply.ok)
            replies += samples.seen
        return Called(replies, errors, time.monotonic() - begun)


class RmwClient(ZenohClient):
    """A node of rmw_zenoh, implemented according to its protocol."""

    def __init__(self, session: zenoh.Session, namespace: str = "", domain: int = 0) -> None:
        super().__init__(session, namespace)
        self.domain = domain
        self.gid = os.urandom(16)
        self._sequence = 0

    def key(self, name: str, type_name: str) -> str:
        return rmw_key(self.full(name), type_name, self.domain)

    def attachment(self, age: float = 0.0) -> bytes:
        """Return the attachment of the next sample, with a stamp `age` seconds ago."""
        self._sequence += 1
        return Attached(self._sequence, time.time_ns() - int(age * 1e9), self.gid).pack()

    def call(
        self,
        name: str,
        type_name: str = TRIGGER,
        payload: bytes = EMPTY_REQUEST,
        attachment: bytes | None = None,
    ) -> Called:
        return self._query(
            self.key(name, type_name),
            payload,
            self.attachment() if attachment is None else attachment or None,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
        )

    @contextmanager
    def tokens(self) -> Iterator[list[str]]:
        """Provide the liveliness tokens of the ROS graph, as each rmw_zenoh node gets them."""
        with listed(self.session, f"@ros2_lv/{self.domain}/**") as tokens:
            yield tokens


class BridgeHalf(ZenohClient):
    """The Zenoh side of zenoh-bridge-ros2dds, emulated. `dds.py` runs the real bridge."""

    def key(self, name: str, type_name: str) -> str:
        return self.full(name)

    def attachment(self) -> None:
        """A bridge sends samples without an attachment."""

    def call(self, name: str, type_name: str = TRIGGER, payload: bytes = EMPTY_REQUEST) -> Called:
        attachment = b"rqh" + os.urandom(16) + b"\1"
        return self._query(self.key(name, type_name), payload, attachment)


@contextmanager
def listed(session: zenoh.Session, pattern: str) -> Iterator[list[str]]:
    """Provide a list of the matching liveliness tokens, updated while the body runs."""
    tokens: list[str] = []

    def on_token(sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT:
            tokens.append(key)
        elif key in tokens:
            tokens.remove(key)

    subscriber = session.liveliness().declare_subscriber(pattern, on_token, history=True)
    try:
        yield tokens
    finally:
        subscriber.undeclare()


@contextmanager
def session_at(endpoint: str) -> Iterator[zenoh.Session]:
    """Provide an ordinary Zenoh session at this address."""
    with zenoh.open(client_config(endpoint)) as session:
        yield session


# two robots


@contextmanager
def two_robots(where: Path, *names: str) -> Iterator[tuple[str, dict[str, Daemon]]]:
    """Start a router and two robots on it, one as a Zenoh peer and one as a Zenoh client.

    Yields the router's address and the daemons by name. A robot's id is also its ROS namespace.
    """
    meeting, daemons = free_endpoint(), {}
    with Program(command_line(ROUTER, meeting), where) as router, ExitStack() as stack:
        router.says("routing")
        for name, mode in zip(names, ("peer", "client"), strict=True):
            config: Tables = {
                "robot": {"id": name},
                "bus": {"connect": [meeting], "mode": mode},
                "ros": {"namespace": name},
                **QUICK,
            }
            robot = Daemon(where, config=config, name=name, ready=False)
            daemons[name] = stack.enter_context(robot)
        for daemon in daemons.values():
            daemon.says("bus ")
        yield meeting, daemons


@contextmanager
def over_router(meeting: str, name: str) -> Iterator[Bus]:
    """Provide a client of one robot over the router, when the robot's link is up."""
    with Bus(meeting, name) as bus:
        until(lambda: bus.ask("info"), 5.0, f"{name} over the router")
        bus.linked()
        yield bus


@contextmanager
def undisturbed(robot: Bus) -> Iterator[None]:
    """Check that this resting robot receives no command and does not move while the body runs."""
    before = robot.at_rest()
    yield
    after = robot.state()
    assert changes(before, after) == {}
    for key in ("x", "mode", "wheels"):
        assert after[key] == before[key], key


# the results of commands


def changes(before: Any, after: Any) -> dict[str, int]:
    """Return the command counters that changed, and by how much."""
    was, now = before["counters"], after["counters"]
    return {
        key: now[key] - was.get(key, 0)
        for key in now
        if key.startswith("command") and now[key] != was.get(key, 0)
    }


def behind(bus: Bus, send: Callable[[], None], reason: str) -> None:
    """Wait until the daemon has received all earlier messages of this client.

    `send` sends a command that the daemon refuses for `reason`. The messages of a link stay in
    order, so all earlier ones have arrived when the refusal is counted. It is sent again if
    necessary, because a sample is dropped within 1 ms of another one on its key.
    """
    before, sent = bus.count(f"command_{reason}"), 0.0

    def counted() -> bool:
        nonlocal sent
        if time.monotonic() - sent > 0.2:
            sent = time.monotonic()
            send()
        return bus.count(f"command_{reason}") > before

    until(counted, 3.0, f"counted as {reason}")


def unharmed(daemon: Daemon) -> None:
    assert daemon.process.poll() is None
    for word in ("Traceback", "Error", "panicked"):
        assert word not in daemon.stderr


# an independent implementation of rmw_zenoh's protocol

SDK = """\
import json, sys, time

import zenoh_ros2_sdk as sdk
from rosbags.typesys import Stores, get_typestore

port, hashes = int(sys.argv[1]), json.loads(sys.argv[2])
router = {"router_ip": "127.0.0.1", "router_port": port}
store = get_typestore(Stores.ROS2_JAZZY)
def definition(type_name):
    return {
        "msg_definition": store.generate_msgdef(type_name, ros_version=2)[0],
        "type_hash": "RIHS01_" + hashes[type_name],
    }

def plain(value):
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__
                if name != "__msgtype__"}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(item) for item in value] if isinstance(value, list) else value

subscribers, last, publishers, callers = {}, {}, {}, {}
manager = sdk.ZenohSession.get_instance("127.0.0.1", port)

def follow(topic, type_name, qos=None):
    subscribers[topic] = sdk.ROS2Subscriber(
        topic, type_name, lambda message: last.__setitem__(topic, message), qos=qos,
        **definition(type_name), **router)

def message(type_name, **fields):
    cls = manager.store.types[type_name]
    return cls(**fields)

def fields(type_name, speed, names):
    vector = lambda x: message("geometry_msgs/msg/Vector3", x=x, y=0.0, z=0.0)
    stamp = time.time_ns()
    if type_name == "sensor_msgs/msg/JointState":
        import numpy as np
        return {"header": message("std_msgs/msg/Header", stamp=message(
                    "builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9),
                    frame_id=""),
                "name": names, "position": np.array([]), "velocity": np.array([speed] * 4),
                "effort": np.array([])}
    twist = {"linear": vector(speed), "angular": vector(0.0)}
    if type_name == "geometry_msgs/msg/Twist":
        return twist
    return {"header": message("std_msgs/msg/Header", stamp=message(
                "builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9),
                frame_id="base_link"),
            "twist": message("geometry_msgs/msg/Twist", **twist)}

def drive(prefix, topic, type_name, speed, names, wanted):
    # Zeros first, then so fast until the odometry says that it drives.
    topic = prefix + topic
    if (topic, type_name) not in publishers:
        publishers[topic, type_name] = sdk.ROS2Publisher(
            topic, type_name, **definition(type_name), **router)
    publisher, begun, top = publishers[topic, type_name], time.monotonic(), 0.0
    while top < wanted and time.monotonic() < begun + 7:
        asked = speed if time.monotonic() > begun + 1.5 else 0.0
        publisher.publish(**fields(type_name, asked, names))
        time.sleep(0.02)
        message = last.get(prefix + "/odom")
        top = message.twist.twist.linear.x if message else 0.0
    publisher.publish(**fields(type_name, 0.0, names))
    return top

def call(service, type_name):
    if service not in callers:
        callers[service] = sdk.ROS2ServiceClient(
            service, type_name, request_definition="# blank",
            response_definition="bool success\\nstring message",
            type_hash="RIHS01_" + hashes[type_name], timeout=5.0, **router)
    return callers[service].call()

def topics():
    return sdk.get_topic_names_and_types(**router)

def services():
    return sdk.get_service_names_and_types(**router)

def nodes(topic):
    info = sdk.get_topic_info(topic, verbose=True, **router)
    return info and [(p.node_namespace, p.node_name, p.qos) for p in info.publishers]

print("ready", flush=True)
verbs = {f.__name__: f for f in (follow, drive, call, topics, services, nodes)}
for line in sys.stdin:
    number, verb, args, kwargs = json.loads(line)
    try:
        answer = plain(verbs[verb](*args, **kwargs))
    except Exception as error:
        answer = {"error": repr(error)}
    print("answer", number, json.dumps(answer, default=plain), flush=True)
manager.close()
"""
"""Executes commands from standard input with zenoh-ros2-sdk, one JSON list per line."""


def bare_environment() -> dict[str, str]:
    """Return the environment of a shell without ROS settings."""
    ours = ("ROS_", "ZENOH_", "CYCLONEDDS_")
    return {key: value for key, value in environment().items() if not key.startswith(ours)}


class Sdk(Program):
    """A process that uses zenoh-ros2-sdk; `do` sends it commands."""

    def __init__(self, endpoint: str, where: Path) -> None:
        port = endpoint.rpartition(":")[2]
        program = command_line(SDK, port, json.dumps(HASHES))
        super().__init__(program, where, bare_environment(), stdin=subprocess.PIPE)
        self._number = 0

    def __enter__(self) -> Sdk:
        super().__enter__()
        self.says("ready")
        return self

    def __exit__(self, *error: object) -> None:
        stdin = self.process.stdin
        assert stdin is not None
        with stdin:
            pass
        try:
            self.process.wait(2.0)
        except subprocess.TimeoutExpired:
            pass
        super().__exit__(*error)

    def do(self, verb: str, *args: object, **kwargs: object) -> Any:
        """Call a function of the SDK in the process, and return its result as plain values."""
        self._number += 1
        stdin = self.process.stdin
        assert stdin is not None
        stdin.write(json.dumps([self._number, verb, args, kwargs]).encode() + b"\n")
        stdin.flush()
        line = self.says(f"answer {self._number} ")
        return json.loads(line.split(" ", 2)[2])
