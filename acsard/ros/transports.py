"""The ROS names of this robot and what each stands for in the native tree.

One list for both transports; the bus declares from it. What comes in on a ROS key is the same
command, and what goes out the same message, as on the native key beside it.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterator
from typing import Literal

from msgspec import Struct

from acsard.config.settings import Config, RosConfig
from acsard.messages.encodings import encoding_name
from acsard.messages.topics import IMU, Direction, service_key
from acsard.ros.names import bridge_key, full_name, rmw_key
from acsard.ros.tokens import Kind, Node, Qos, bridge_presence, bridge_token
from acsard.values import ROOT

Transport = Literal["bridge", "rmw"]


class RosName(Struct, frozen=True):
    """A topic or service: its relative `name`, and the native key it stands for."""

    name: str
    native: str
    direction: Direction
    """That of the native key; to ROS a query is a service too."""
    type: str
    qos: Qos = Qos()


class Endpoint(Struct, frozen=True):
    """One key to declare on the bus."""

    transport: Transport
    native: str
    direction: Direction
    key: str
    token: str
    """Its liveliness token, "" for none; over rmw also what its GID is made of."""
    latched: bool
    type: str
    """The ROS type its key names; by a bridge, where a name may take two, the first."""

    @property
    def encoding(self) -> str:
        """Of what comes in on it, which names none: a bridge's Twist or TwistStamped is told by
        its length only."""
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
"""Where the parameter services would be in the native tree, which has `config` instead."""

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
"""The command source each commanding topic counts as."""

GYRO = RosName("imu/data", IMU, "in", "sensor_msgs/msg/Imu", Qos(best_effort=True))
"""As drivers of sensors publish it (SensorDataQoS) or better."""


def left_out(config: Config) -> frozenset[str]:
    """The native keys that have nothing to say or to hear: ROS tools would take them for more."""
    silent = set() if config.odometry.publish_tf else {"tf"}
    if not config.odometry.gyro or config.mcu.simulated:  # the simulated robot has a gyro itself
        silent.add(IMU)
    if not (config.lidar.publish_tf or config.footprint.publish_tf):
        silent.add("tf_static")
    return frozenset(silent)


def ros_names(ros: RosConfig, silent: Container[str] = ()) -> tuple[RosName, ...]:
    """All topics and services; a twist topic that takes both types is there once for each."""
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
    """The text with the services called as ROS calls them: /acsard/clear, not srv/clear."""
    return _NAMED.sub(lambda found: full_name(ros.namespace, f"{ros.node}/{found[1]}"), text)


def endpoints(ros: RosConfig, zid: str, silent: Container[str] = ()) -> tuple[Endpoint, ...]:
    """The keys of every tree that is switched on, for a session with this Zenoh id."""
    names = ros_names(ros, silent)
    found: list[Endpoint] = []
    if ros.bridge:
        found += _bridge(ros, zid, names)
    if ros.rmw:
        found += _rmw(ros, zid, names)
    return tuple(found)


def node_tokens(ros: RosConfig, zid: str) -> tuple[str, ...]:
    """The tokens beside those of the endpoints: that there is a node, or a bridge."""
    tokens = []
    if ros.bridge and ros.announce:
        tokens.append(bridge_presence(zid))
    if ros.rmw:
        tokens.append(_node(ros, zid).token)
    return tuple(tokens)


def command_keys(ros: RosConfig) -> tuple[str, ...]:
    """The keys commands come in on."""
    return tuple({e.key: None for e in endpoints(ros, "0") if e.direction == "in"})


def claims(ros: RosConfig) -> tuple[str, ...]:
    """Tokens that say which ROS names a daemon obeys: two that have one of them are both driven by
    one `cmd_vel`. In a tree of our own, since other nodes may be called as ours, and not every
    daemon has tokens for ROS."""
    name = full_name(ros.namespace, "cmd_vel")
    ways = (("bridge", ros.bridge), (f"rmw/{ros.domain}", ros.rmw))
    return tuple(f"{ROOT}/@ros/{way}{name}" for way, on in ways if on)


def _node(ros: RosConfig, zid: str) -> Node:
    return Node(ros.domain, zid, ros.namespace, ros.node)


def _bridge(ros: RosConfig, zid: str, names: tuple[RosName, ...]) -> Iterator[Endpoint]:
    """One key a name; a topic of two types cannot be announced, as a DDS reader has one."""
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
