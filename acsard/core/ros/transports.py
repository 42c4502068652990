"""The robot's ROS names, and the native key that each of them stands for.

One list serves both transports, and the bus declares its endpoints from it. A message on a ROS key
means the same as on its native key, in both directions.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterator
from typing import Literal

from msgspec import Struct

from acsard.core.config.settings import Config, RosConfig
from acsard.core.messages.encodings import encoding_name
from acsard.core.messages.topics import IMU, Direction, service_key
from acsard.core.ros.names import (
    Kind,
    Node,
    Qos,
    bridge_key,
    bridge_presence,
    bridge_token,
    full_name,
    rmw_key,
)
from acsard.core.values import ROOT

Transport = Literal["bridge", "rmw"]


class RosName(Struct, frozen=True):
    """A topic or service with its relative `name`, and the native key that it stands for."""

    name: str
    native: str
    direction: Direction
    """Direction of the native key. In ROS a query is a service too."""
    type: str
    qos: Qos = Qos()


class Endpoint(Struct, frozen=True):
    """A key to declare on the bus."""

    transport: Transport
    native: str
    direction: Direction
    key: str
    token: str
    """Liveliness token, or "" if it has none. On rmw, the GID is derived from it."""
    latched: bool
    type: str
    """ROS type that the key names. A bridge's key that accepts two types has the first of them."""

    @property
    def encoding(self) -> str:
        """Encoding to assume for an incoming sample, because the samples themselves name none.

        On a bridge's key only the length tells a Twist from a TwistStamped.
        """
        cdr = encoding_name("cdr")
        return f"{cdr};{self.type}" if self.transport == "rmw" else cdr


KINDS: dict[Direction, Kind] = {"out": "MP", "in": "MS", "query": "SS", "service": "SS"}

TRIGGERS = ("stop", "clear", "activate", "deactivate", "reset_odometry")

_NAMED = re.compile(rf"\bsrv/({'|'.join(TRIGGERS)})\b")

PARAMETER_SERVICES = {
    "describe_parameters": "rcl_interfaces/srv/DescribeParameters",
    "get_parameter_types": "rcl_interfaces/srv/GetParameterTypes",
    "get_parameters": "rcl_interfaces/srv/GetParameters",
    "list_parameters": "rcl_interfaces/srv/ListParameters",
    "set_parameters": "rcl_interfaces/srv/SetParameters",
    "set_parameters_atomically": "rcl_interfaces/srv/SetParametersAtomically",
}

PARAMETERS = "parameters/"
"""Prefix of the parameter services in place of a native key; the native tree has `config`."""

PUBLISHED = (
    RosName("odom", "odom", "out", "nav_msgs/msg/Odometry"),
    RosName("tf", "tf", "out", "tf2_msgs/msg/TFMessage", Qos(100)),
    RosName("tf_static", "tf_static", "out", "tf2_msgs/msg/TFMessage", Qos(1, transient=True)),
    RosName("joint_states", "wheel_states", "out", "sensor_msgs/msg/JointState"),
    RosName("diagnostics", "diagnostics", "out", "diagnostic_msgs/msg/DiagnosticArray"),
    RosName("cmd_vel_out", "cmd_vel_out", "out", "geometry_msgs/msg/TwistStamped"),
)

TWISTS = {"twist": "geometry_msgs/msg/Twist", "twist_stamped": "geometry_msgs/msg/TwistStamped"}

SOURCES = {"cmd_vel": "nav", "cmd_vel_teleop": "teleop", "joint_commands": "ros2_control"}
"""The command source of each topic that commands the robot."""

GYRO = RosName("imu/data", IMU, "in", "sensor_msgs/msg/Imu", Qos(best_effort=True))
"""Subscription to a gyro; its QoS accepts drivers that publish with SensorDataQoS or better."""


def left_out(config: Config) -> frozenset[str]:
    """Return the native keys without content, so that ROS tools do not show them as topics."""
    silent = set() if config.odometry.publish_tf else {"tf"}
    # The simulated robot has a gyro of its own.
    if not config.odometry.gyro or config.mcu.simulated:
        silent.add(IMU)
    if not (config.lidar.publish_tf or config.footprint.publish_tf):
        silent.add("tf_static")
    return frozenset(silent)


def ros_names(ros: RosConfig, silent: Container[str] = ()) -> tuple[RosName, ...]:
    """Return all topics and services.

    A twist topic that accepts both types appears once for each type.
    """
    kinds = [kind for kind in TWISTS if ros.cmd_vel_type in ("auto", kind)]
    return (
        *(row for row in PUBLISHED if row.native not in silent),
        *(
            RosName(name, f"cmd/{SOURCES[name]}", "in", TWISTS[kind])
            for name in ("cmd_vel", "cmd_vel_teleop")
            for kind in kinds
        ),
        RosName(
            "joint_commands",
            f"wheel_cmd/{SOURCES['joint_commands']}",
            "in",
            "sensor_msgs/msg/JointState",
        ),
        *(row for row in (GYRO,) if row.native not in silent),
        *(
            RosName(f"{ros.node}/{verb}", service_key(verb), "service", "std_srvs/srv/Trigger")
            for verb in TRIGGERS
        ),
        *(
            RosName(f"{ros.node}/{name}", PARAMETERS + name, "query", type_name)
            for name, type_name in PARAMETER_SERVICES.items()
        ),
    )


def in_ros_words(text: str, ros: RosConfig) -> str:
    """Replace the services in a text by their ROS names: srv/clear by /acsard/clear."""
    return _NAMED.sub(lambda found: full_name(ros.namespace, f"{ros.node}/{found[1]}"), text)


def endpoints(ros: RosConfig, zid: str, silent: Container[str] = ()) -> tuple[Endpoint, ...]:
    """Return the keys of every enabled transport, for a session with this Zenoh id."""
    names = ros_names(ros, silent)
    found: list[Endpoint] = []
    if ros.bridge:
        found += _bridge(ros, zid, names)
    if ros.rmw:
        found += _rmw(ros, zid, names)
    return tuple(found)


def node_tokens(ros: RosConfig, zid: str) -> tuple[str, ...]:
    """Return the tokens besides those of the endpoints, which announce the node or the bridge."""
    tokens = []
    if ros.bridge and ros.announce:
        tokens.append(bridge_presence(zid))
    if ros.rmw:
        tokens.append(_node(ros, zid).token)
    return tuple(tokens)


def command_keys(ros: RosConfig) -> tuple[str, ...]:
    """Return the ROS keys on which commands arrive."""
    return tuple({e.key: None for e in endpoints(ros, "0") if e.direction == "in"})


def claims(ros: RosConfig) -> tuple[str, ...]:
    """Return tokens that say which ROS names a daemon obeys.

    Two daemons with a common token would both be driven by one `cmd_vel`. The tokens are in
    acsard's own tree, because other nodes may have the same names, and not every daemon announces
    itself to ROS.
    """
    name = full_name(ros.namespace, "cmd_vel")
    ways = (("bridge", ros.bridge), (f"rmw/{ros.domain}", ros.rmw))
    return tuple(f"{ROOT}/@ros/{way}{name}" for way, on in ways if on)


def _node(ros: RosConfig, zid: str) -> Node:
    return Node(ros.domain, zid, ros.namespace, ros.node)


def _bridge(ros: RosConfig, zid: str, names: tuple[RosName, ...]) -> Iterator[Endpoint]:
    """Yield one endpoint per name.

    A topic with two types is not announced, as a DDS reader has one type.
    """
    for row in names:
        twins = [other for other in names if other.name == row.name]
        if row is not twins[0]:
            continue
        name = full_name(ros.namespace, row.name)
        token = ""
        if ros.announce and len(twins) == 1:
            token = bridge_token(zid, KINDS[row.direction], name, row.type, row.qos)
        yield _endpoint("bridge", row, bridge_key(name), token)


def _rmw(ros: RosConfig, zid: str, names: tuple[RosName, ...]) -> Iterator[Endpoint]:
    node = _node(ros, zid)
    for number, row in enumerate(names, start=1):
        name = full_name(ros.namespace, row.name)
        token = node.endpoint_token(number, KINDS[row.direction], name, row.type, row.qos)
        yield _endpoint("rmw", row, rmw_key(ros.domain, name, row.type), token)


def _endpoint(transport: Transport, row: RosName, key: str, token: str) -> Endpoint:
    latched = row.qos.transient
    return Endpoint(transport, row.native, row.direction, key, token, latched, row.type)
