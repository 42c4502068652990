"""The table of the robot's ROS topics and services, with the native key of each.

A native key is acsard's own. A ROS key is that of a transport, zenoh-bridge-ros2dds ("bridge") or
rmw_zenoh_cpp ("rmw"). The bus declares its ROS endpoints from this table.
"""

from __future__ import annotations

from collections.abc import Container, Iterator
from typing import Literal

from msgspec import Struct

from acsard.core.config.settings import Config, RosConfig
from acsard.core.messages.encodings import encoding_name
from acsard.core.messages.keys_and_roles import (
    IMU,
    PLAIN_SERVICES,
    SPEED_LIMIT,
    STOP,
    Direction,
    service_key,
)
from acsard.core.ros.names import (
    NODE,
    Kind,
    Node,
    Qos,
    bridge_key,
    bridge_presence,
    bridge_token,
    bridged_publishers,
    full_name,
    rmw_key,
    rmw_publishers,
)
from acsard.core.values import ROOT_KEY

Transport = Literal["bridge", "rmw"]


class RosName(Struct, frozen=True):
    """A ROS topic or service, with the native key for the same messages."""

    name: str  # relative to the robot's namespace
    native: str  # without `acsard/<robot.id>/`
    direction: Direction  # of the native key; "query" and "service" are services
    type: str
    qos: Qos = Qos()


class Endpoint(Struct, frozen=True):
    """A ROS topic or service that the daemon declares for one ROS transport."""

    transport: Transport
    native: str  # without `acsard/<robot.id>/`
    direction: Direction
    key: str
    token: str  # liveliness, if it is announced; the GID is a hash of it
    latched: bool  # a new subscriber gets the last message
    type: str  # the first one of two, which only the bridge allows

    @property
    def encoding(self) -> str:
        """Zenoh Encoding to assume, because samples from ROS have none.

        For rmw it has the type. For the bridge, the length of a sample shows whether it is a Twist
        or a TwistStamped.
        """
        cdr = encoding_name("cdr")
        return f"{cdr};{self.type}" if self.transport == "rmw" else cdr


KINDS: dict[Direction, Kind] = {"out": "MP", "in": "MS", "query": "SS", "service": "SS"}


PARAMETER_SERVICES = {
    "describe_parameters": "rcl_interfaces/srv/DescribeParameters",
    "get_parameter_types": "rcl_interfaces/srv/GetParameterTypes",
    "get_parameters": "rcl_interfaces/srv/GetParameters",
    "list_parameters": "rcl_interfaces/srv/ListParameters",
    "set_parameters": "rcl_interfaces/srv/SetParameters",
    "set_parameters_atomically": "rcl_interfaces/srv/SetParametersAtomically",
}

# Prefix of `RosName.native` for ROS parameter services; native clients use the key `config`.
PARAMETERS_PREFIX = "parameters/"

PUBLISHED = (
    RosName("odom", "odom", "out", "nav_msgs/msg/Odometry"),
    RosName("tf", "tf", "out", "tf2_msgs/msg/TFMessage", Qos(100)),
    RosName("tf_static", "tf_static", "out", "tf2_msgs/msg/TFMessage", Qos(1, transient=True)),
    RosName("joint_states", "wheel_states", "out", "sensor_msgs/msg/JointState"),
    RosName("diagnostics", "diagnostics", "out", "diagnostic_msgs/msg/DiagnosticArray"),
    RosName("battery_state", "battery", "out", "sensor_msgs/msg/BatteryState"),
    RosName("cmd_vel_out", "cmd_vel_out", "out", "geometry_msgs/msg/TwistStamped"),
)

TWISTS = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")

# Command sources by the ROS topic that commands the robot.
SOURCES = {
    "cmd_vel": "nav",
    "cmd_vel_dock": "dock",
    "cmd_vel_teleop": "teleop",
    "joint_commands": "ros2_control",
}

# The topic of Nav2's speed filter.
SPEED_LIMIT_TOPIC = RosName(SPEED_LIMIT, SPEED_LIMIT, "in", "nav2_msgs/msg/SpeedLimit")

# Any message stops, so a node stops by its topics where the bridge drops its service calls. The
# subscription is reliable: a stop that DDS loses is sent again.
STOP_TOPIC = RosName("stop_request", STOP, "in", "std_msgs/msg/Empty")

# Best effort also receives from drivers with SensorDataQoS.
GYRO_TOPIC = RosName("imu/data", IMU, "in", "sensor_msgs/msg/Imu", Qos(best_effort=True))


def unused_keys(config: Config) -> frozenset[str]:
    """Return the native keys that are not used, and so not announced to ROS."""
    silent = set() if config.odometry.publish_tf else {"tf"}
    # The simulated robot has its own gyro, so the daemon does not subscribe to another one.
    if not config.odometry.gyro or config.mcu.simulated:
        silent.add(IMU)
    if not config.lidar.publish_tf:
        silent.add("tf_static")
    return frozenset(silent)


def ros_names(silent: Container[str] = ()) -> tuple[RosName, ...]:
    """Return the ROS names, without namespace and native keys in `silent` (`unused_keys`).

    One for Twist and TwistStamped appears twice.
    """
    return (
        *(row for row in PUBLISHED if row.native not in silent),
        *(
            RosName(name, f"cmd/{SOURCES[name]}", "in", type_name)
            for name in ("cmd_vel", "cmd_vel_dock", "cmd_vel_teleop")
            for type_name in TWISTS
        ),
        RosName(
            "joint_commands",
            f"wheel_cmd/{SOURCES['joint_commands']}",
            "in",
            "sensor_msgs/msg/JointState",
        ),
        SPEED_LIMIT_TOPIC,
        STOP_TOPIC,
        *(row for row in (GYRO_TOPIC,) if row.native not in silent),
        *(
            RosName(f"{NODE}/{verb}", service_key(verb), "service", "std_srvs/srv/Trigger")
            for verb in PLAIN_SERVICES
        ),
        *(
            RosName(f"{NODE}/{name}", PARAMETERS_PREFIX + name, "query", type_name)
            for name, type_name in PARAMETER_SERVICES.items()
        ),
    )


def endpoints(ros: RosConfig, zid: str, silent: Container[str] = ()) -> tuple[Endpoint, ...]:
    """Return the endpoints of all ROS transports that are switched on, without `silent` keys."""
    names = ros_names(silent)
    ros_endpoints: list[Endpoint] = []
    if ros.bridge:
        ros_endpoints += _bridge(ros, zid, names)
    if ros.rmw:
        ros_endpoints += _rmw(ros, zid, names)
    return tuple(ros_endpoints)


def node_tokens(ros: RosConfig, zid: str) -> tuple[str, ...]:
    """Return the liveliness tokens that announce the daemon itself to ROS, one per transport."""
    tokens = []
    if ros.bridge:
        tokens.append(bridge_presence(zid))
    if ros.rmw:
        tokens.append(_node(ros, zid).token)
    return tuple(tokens)


def command_keys(ros: RosConfig) -> tuple[str, ...]:
    """Return the Zenoh keys on which commands, speed limits and gyro samples arrive from ROS."""
    incoming = (e for e in endpoints(ros, "0") if e.direction == "in" and e.native != STOP)
    return tuple({e.key: None for e in incoming})


def stop_keys(ros: RosConfig) -> tuple[str, ...]:
    """Return the Zenoh keys on which stops arrive from ROS."""
    return tuple(e.key for e in endpoints(ros, "0") if e.native == STOP)


def announced_publishers(config: Config) -> tuple[tuple[str, str, Transport], ...]:
    """Return the tokens of publishers for the sources where a pause arms, as key expressions.

    The source and the transport are beside each.
    """
    ros, found = config.ros, list[tuple[str, str, Transport]]()
    pausing = [source.name for source in config.commands.sources if source.neutral_first == "pause"]
    for topic, source in SOURCES.items():
        name = full_name(ros.namespace, topic)
        if source in pausing and ros.bridge:
            found.append((bridged_publishers(name), source, "bridge"))
        if source in pausing and ros.rmw:
            found.append((rmw_publishers(ros.domain, name), source, "rmw"))
    return tuple(found)


def claims(ros: RosConfig) -> tuple[str, ...]:
    """Return the tokens with which this daemon claims the ROS topic `cmd_vel`.

    Two daemons with the same one would follow the same `cmd_vel`, so the second does not start.
    Tokens that announce endpoints are no claims, because other nodes may use the names.
    """
    name = full_name(ros.namespace, "cmd_vel")
    trees = (("bridge", ros.bridge), (f"rmw/{ros.domain}", ros.rmw))
    return tuple(f"{ROOT_KEY}/@ros/{tree}{name}" for tree, on in trees if on)


def _node(ros: RosConfig, zid: str) -> Node:
    return Node(ros.domain, zid, ros.namespace, NODE)


def _bridge(ros: RosConfig, zid: str, names: tuple[RosName, ...]) -> Iterator[Endpoint]:
    # One with two types is not announced: a DDS reader has only one type.
    for row in names:
        twins = [other for other in names if other.name == row.name]
        if row is not twins[0]:
            continue
        name = full_name(ros.namespace, row.name)
        token = ""
        if len(twins) == 1:
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
