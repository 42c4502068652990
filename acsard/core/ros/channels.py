"""The table of topics in MCAP files and live viewers: name, ROS type and message definition.

All are CDR with their `ros2msg` definitions (ROS 2 Jazzy and later), for Foxglove, Lichtblick and
PlotJuggler; `ros2 bag play` refuses a file with another encoding. `state` has a type of the package
`acsard`, which it skips and viewers show. Names and types come from `transports.py`.
"""

from __future__ import annotations

from collections.abc import Container, Iterator
from typing import Annotated, Any

from msgspec import Meta, Struct, convert, defstruct

from acsard.core.messages.encodings import encode
from acsard.core.messages.keys_and_roles import by_key
from acsard.core.messages.schema import MESSAGES, Header, Imu, RobotState, TwistStamped
from acsard.core.ros.names import Qos, full_name
from acsard.core.ros.shapes import Log
from acsard.core.ros.transports import GYRO_TOPIC, PUBLISHED

ACSARD_PREFIX = "acsard/msg/"  # of types that ROS does not have

Field = tuple[str, str]  # type and name

# A line is a type, a colon, and its constants (`type NAME=value`) and fields (`type name`, `type
# name default`). `[]` is a sequence, `[n]` an array.
_TEXT = """
builtin_interfaces/msg/Time: int32 sec, uint32 nanosec
std_msgs/msg/Header: builtin_interfaces/msg/Time stamp, string frame_id
geometry_msgs/msg/Vector3: float64 x, float64 y, float64 z
geometry_msgs/msg/Point: float64 x, float64 y, float64 z
geometry_msgs/msg/Quaternion: float64 x 0, float64 y 0, float64 z 0, float64 w 1
geometry_msgs/msg/Twist: geometry_msgs/msg/Vector3 linear, geometry_msgs/msg/Vector3 angular
geometry_msgs/msg/TwistStamped: std_msgs/msg/Header header, geometry_msgs/msg/Twist twist
geometry_msgs/msg/TwistWithCovariance: geometry_msgs/msg/Twist twist, float64[36] covariance
geometry_msgs/msg/Pose: geometry_msgs/msg/Point position, geometry_msgs/msg/Quaternion orientation
geometry_msgs/msg/PoseWithCovariance: geometry_msgs/msg/Pose pose, float64[36] covariance
geometry_msgs/msg/Transform: \
    geometry_msgs/msg/Vector3 translation, geometry_msgs/msg/Quaternion rotation
geometry_msgs/msg/TransformStamped: \
    std_msgs/msg/Header header, string child_frame_id, geometry_msgs/msg/Transform transform
nav_msgs/msg/Odometry: \
    std_msgs/msg/Header header, string child_frame_id, \
    geometry_msgs/msg/PoseWithCovariance pose, geometry_msgs/msg/TwistWithCovariance twist
tf2_msgs/msg/TFMessage: geometry_msgs/msg/TransformStamped[] transforms
sensor_msgs/msg/JointState: \
    std_msgs/msg/Header header, string[] name, \
    float64[] position, float64[] velocity, float64[] effort
sensor_msgs/msg/Imu: \
    std_msgs/msg/Header header, \
    geometry_msgs/msg/Quaternion orientation, float64[9] orientation_covariance, \
    geometry_msgs/msg/Vector3 angular_velocity, float64[9] angular_velocity_covariance, \
    geometry_msgs/msg/Vector3 linear_acceleration, float64[9] linear_acceleration_covariance
sensor_msgs/msg/BatteryState: \
    uint8 POWER_SUPPLY_STATUS_UNKNOWN=0, uint8 POWER_SUPPLY_STATUS_CHARGING=1, \
    uint8 POWER_SUPPLY_STATUS_DISCHARGING=2, uint8 POWER_SUPPLY_STATUS_NOT_CHARGING=3, \
    uint8 POWER_SUPPLY_STATUS_FULL=4, \
    uint8 POWER_SUPPLY_HEALTH_UNKNOWN=0, uint8 POWER_SUPPLY_HEALTH_GOOD=1, \
    uint8 POWER_SUPPLY_HEALTH_OVERHEAT=2, uint8 POWER_SUPPLY_HEALTH_DEAD=3, \
    uint8 POWER_SUPPLY_HEALTH_OVERVOLTAGE=4, uint8 POWER_SUPPLY_HEALTH_UNSPEC_FAILURE=5, \
    uint8 POWER_SUPPLY_HEALTH_COLD=6, uint8 POWER_SUPPLY_HEALTH_WATCHDOG_TIMER_EXPIRE=7, \
    uint8 POWER_SUPPLY_HEALTH_SAFETY_TIMER_EXPIRE=8, \
    uint8 POWER_SUPPLY_TECHNOLOGY_UNKNOWN=0, uint8 POWER_SUPPLY_TECHNOLOGY_NIMH=1, \
    uint8 POWER_SUPPLY_TECHNOLOGY_LION=2, uint8 POWER_SUPPLY_TECHNOLOGY_LIPO=3, \
    uint8 POWER_SUPPLY_TECHNOLOGY_LIFE=4, uint8 POWER_SUPPLY_TECHNOLOGY_NICD=5, \
    uint8 POWER_SUPPLY_TECHNOLOGY_LIMN=6, uint8 POWER_SUPPLY_TECHNOLOGY_TERNARY=7, \
    uint8 POWER_SUPPLY_TECHNOLOGY_VRLA=8, \
    std_msgs/msg/Header header, float32 voltage, float32 temperature, float32 current, \
    float32 charge, float32 capacity, float32 design_capacity, float32 percentage, \
    uint8 power_supply_status, uint8 power_supply_health, uint8 power_supply_technology, \
    bool present, float32[] cell_voltage, float32[] cell_temperature, \
    string location, string serial_number
diagnostic_msgs/msg/KeyValue: string key, string value
diagnostic_msgs/msg/DiagnosticStatus: \
    byte OK=0, byte WARN=1, byte ERROR=2, byte STALE=3, \
    byte level, string name, string message, string hardware_id, \
    diagnostic_msgs/msg/KeyValue[] values
diagnostic_msgs/msg/DiagnosticArray: \
    std_msgs/msg/Header header, diagnostic_msgs/msg/DiagnosticStatus[] status
rcl_interfaces/msg/Log: \
    uint8 DEBUG=10, uint8 INFO=20, uint8 WARN=30, uint8 ERROR=40, uint8 FATAL=50, \
    builtin_interfaces/msg/Time stamp, uint8 level, string name, string msg, \
    string file, string function, uint32 line
acsard/msg/Counter: string name, int64 count
acsard/msg/SourceState: string name, int64 priority, float64 age, string waits_for, \
    string wait, float64 linear, float64 angular, float64 longest_gap
acsard/msg/RobotState: \
    std_msgs/msg/Header header, string mode, string code, string reason, \
    float64 x, float64 y, float64 yaw, float64 linear, float64 angular, float64[] wheels, \
    float64 feedback_age, string link, string source, string sender, \
    acsard/msg/SourceState[] sources, \
    string refused, string gyro, string wheel_fault, string pose_doubt, \
    string emergency_stop, bool[] bumpers, \
    string recording_error, string certificate_expiry, acsard/msg/Counter[] counters
"""


def _parsed(text: str) -> dict[str, tuple[tuple[str, str], ...]]:
    table = {}
    for line in text.strip().splitlines():
        name, _, declared = line.partition(":")
        pairs = [field.split(maxsplit=1) for field in declared.split(",")]
        table[name] = tuple((kind, rest) for kind, rest in pairs)
    return table


_DECLARED = _parsed(_TEXT)  # by type, pairs such as ("float64", "x 0")

# Fields by type, without constants.
DEFINITIONS: dict[str, tuple[Field, ...]] = {
    name: tuple((kind, rest.split()[0]) for kind, rest in declared if "=" not in rest)
    for name, declared in _DECLARED.items()
}

SEPARATOR_LINE = "=" * 80


def schema_text(name: str) -> str:
    """Return a type with its nested types in MCAP's `ros2msg` format."""
    parts = [_fields(name)]
    parts += [f"{SEPARATOR_LINE}\nMSG: {_short(other)}\n{_fields(other)}" for other in nested(name)]
    return "".join(parts)


def nested(name: str) -> tuple[str, ...]:
    """Return all nested types, at any depth, in the order of first use."""
    return tuple(dict.fromkeys(_nested(name)))


def _nested(name: str) -> Iterator[str]:
    for kind, _ in DEFINITIONS[name]:
        base = kind.partition("[")[0]
        if "/" in base:
            yield base
            yield from _nested(base)


def _fields(name: str) -> str:
    return "".join(f"{_short(kind)} {rest}\n" for kind, rest in _DECLARED[name])


def _short(kind: str) -> str:
    return kind.replace("/msg/", "/")


# The types of the fields of the package `acsard`. CDR has no null, which is NaN (`cdr_types.py`).
_TYPES: dict[str, Any] = {
    "string": str,
    "int64": Annotated[int, Meta(extra={"cdr": "q"})],
    "float64": float | None,
    "float64[]": list[float],
    "bool[]": list[bool],
    "std_msgs/msg/Header": Header,
}


def _struct(name: str) -> type[Struct]:
    fields = [
        (field, _TYPES[kind] if kind in _TYPES else list[_struct(kind.removesuffix("[]"))])  # type: ignore[misc]
        for kind, field in DEFINITIONS[name]
    ]
    return defstruct(name.rpartition("/")[2], fields, frozen=True)


STATE_TYPE = ACSARD_PREFIX + "RobotState"

RosState = _struct(STATE_TYPE)


def state(message: RobotState) -> Struct:
    """Convert a `RobotState` to the type of ROS. CDR has no maps, so the counters are a list."""
    same = {name: getattr(message, name, None) for name in RosState.__struct_fields__}
    other = {
        "header": Header(message.stamp),
        "bumpers": message.bumpers or [],
        "counters": [{"name": name, "count": count} for name, count in message.counters.items()],
    }
    return convert(same | other, RosState, from_attributes=True)


ENCODING, SCHEMA_ENCODING = "cdr", "ros2msg"  # in MCAP and in Foxglove's protocol

SOURCE_PLACEHOLDER = "<source>"


class Channel(Struct, frozen=True):
    """A topic in MCAP files and live viewers; `<source>` stands for a command source."""

    name: str  # relative to the namespace
    native: str  # native key, without `acsard/<robot.id>/`
    schema_name: str  # `pkg/msg/Name`
    message: type[Struct]  # as CDR encodes it
    qos: Qos = Qos()

    def topic(self, namespace: str, source: str = "") -> str:
        """Return the full name, with its leading slash; `source` replaces `<source>`."""
        return full_name(namespace, self.name.replace(SOURCE_PLACEHOLDER, source))

    @property
    def schema(self) -> str:
        """The type with its nested types, in MCAP's `ros2msg` format."""
        return schema_text(self.schema_name)

    def encode(self, message: Any) -> bytes:
        """Encode a message as CDR; a `RobotState` becomes `RosState`."""
        return encode(state(message) if isinstance(message, RobotState) else message, "cdr")


def _published() -> dict[str, Channel]:
    channels = {}
    for row in PUBLISHED:
        topic = by_key(row.native)
        assert topic is not None, row.native
        channels[row.native] = Channel(
            row.name, row.native, row.type, MESSAGES[topic.type], row.qos
        )
    return channels


STATE_CHANNEL = Channel("state", "state", STATE_TYPE, RosState)

# Each event is one log message.
LOG_CHANNEL = Channel("log", "events", "rcl_interfaces/msg/Log", Log, Qos(1000))

# One for each command source; the stamp is the arrival.
CMD_VEL_IN = Channel(
    f"cmd_vel_in/{SOURCE_PLACEHOLDER}",
    f"cmd/{SOURCE_PLACEHOLDER}",
    "geometry_msgs/msg/TwistStamped",
    TwistStamped,
)

# In exports only: the samples that the daemon received.
IMU_CHANNEL = Channel(GYRO_TOPIC.name, GYRO_TOPIC.native, GYRO_TOPIC.type, Imu, GYRO_TOPIC.qos)

# Channels by key, for all messages that `Report` builds.
BY_KEY: dict[str, Channel] = {**_published(), STATE_CHANNEL.native: STATE_CHANNEL}

CHANNELS: tuple[Channel, ...] = (*BY_KEY.values(), CMD_VEL_IN, LOG_CHANNEL)


def published_channels(silent: Container[str]) -> tuple[Channel, ...]:
    """Return all channels but those whose native key is in `silent` (`unused_keys`)."""
    return tuple(channel for channel in CHANNELS if channel.native not in silent)
