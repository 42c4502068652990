"""The table of all keys below `acsard/<id>/`: direction, type, rate, meaning and required roles.

A key that is not in it does not exist: the bus declares its keys, and `permissions.py` derives the
roles' permissions from it. `acsard topics`, the manual and the reply to `topics` show it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from typing import Literal, NamedTuple

from msgspec import Struct

from acsard.core.config.nearest import hint
from acsard.core.config.settings import Config
from acsard.core.values import ROOT_KEY, Role, Verb

_PLACE = re.compile("<[A-Za-z]+>")

# out: the daemon publishes. in: clients put. query: the daemon answers, also to wildcards. service:
# only a query for exactly this key.
Direction = Literal["out", "in", "query", "service"]


class Topic(Struct, frozen=True):
    key: str  # below the robot's id, with placeholders such as `<source>`
    direction: Direction
    type: str  # name in `MESSAGES`, or a description
    rate: str  # in words
    note: str
    publish: Role | None = None  # lowest role; None: no client
    subscribe: Role | None = None  # lowest role; None: no client
    # Lowest role; `<role>`: the last part of the queried key.
    query: Role | Literal["<role>"] | None = None
    local: bool = False  # only for programs on the robot's own machine
    latched: bool = False  # a new subscriber gets the last message
    simulated: bool = False  # only with the built-in simulator
    gyro: bool = False  # only with `[odometry] gyro = true`

    @property
    def pattern(self) -> str:
        """The key with Zenoh wildcards as placeholders."""
        return _PLACE.sub("*", self.key.replace("<key>", "**"))


class Service(NamedTuple):
    least: Role  # lowest role
    note: str
    payload: str = ""  # name in `MESSAGES`
    example: str = ""  # payload in JSON
    optional: bool = False  # the payload


# The services for the bus, ROS, the page and the tools.
SERVICES: dict[Verb, Service] = {
    "stop": Service("viewer", "stop the robot; it stays stopped until srv/clear is called"),
    "clear": Service(
        "operator",
        "release the causes of faults and stops that the payload {numbers} names; without a "
        "payload, the faults if there are any, else the stops",
        "Release",
        '{"numbers": [180000000000001]}',
        optional=True,
    ),
    "activate": Service(
        "operator",
        "switch the robot on, so that it follows commands; the payload {numbers} names the cause "
        "to release",
        "Release",
        '{"numbers": [180000000000001]}',
        optional=True,
    ),
    "deactivate": Service(
        "operator",
        "switch the robot off: it slows down to zero and ignores commands",
        "SwitchOff",
        '{"release_port": false}',
        optional=True,
    ),
    "reset_odometry": Service("operator", "set the pose to x 0, y 0, yaw 0"),
    "set_pose": Service(
        "maintainer",
        "set the pose to the payload {x, y, yaw}",
        "SetPose",
        '{"x": 0, "y": 0, "yaw": 0}',
    ),
    "set": Service(
        "maintainer",
        "change settings until the next start; the payload is {settings: {key: value}}",
        "Settings",
        '{"settings": {"limits.linear_speed": 0.8}}',
    ),
}

# Callable without a payload.
PLAIN_SERVICES = tuple(
    verb for verb, service in SERVICES.items() if service.optional or not service.payload
)

BEAT, BEAT_HZ = "beat", 20.0

IMU = "imu"  # samples of the real or simulated gyro

SPEED_LIMIT = "speed_limit"  # lowers the highest speed, for example by Nav2's speed filter

STOP = "stop"  # any PUT on it stops the robot

# The access rules let a client query only the keys of its role and lower ones, so an answer proves
# at least the role of the key.
WHOAMI = "whoami/<role>"


def whoami_key(role: str) -> str:
    """Return the key that only clients with this role or a higher one can query."""
    return WHOAMI.replace("<role>", role)


# For a service that the daemon does not have, such as one of a later version: it refuses the call
# in words. Over TLS only exact keys are allowed, so there the client explains the silence.
ANY_SERVICE = "srv/<verb>"

SERVICE_NAME = re.compile("[a-z0-9_]{1,40}")


def service_key(verb: str) -> str:
    return ANY_SERVICE.replace("<verb>", verb)


def is_service(key: str) -> bool:
    """Return whether a key calls a service, which this version may not know."""
    return key.startswith(service_key(""))


JSON_TREE = "json/"


def json_key(key: str) -> str:
    return JSON_TREE + key


# Verbs by key, such as `srv/stop`.
VERBS: dict[str, Verb] = {service_key(verb): verb for verb in SERVICES}


def _out(
    key: str,
    kind: str,
    rate: str,
    note: str,
    *,
    latched: bool = False,
    simulated: bool = False,
) -> Topic:
    return Topic(
        key, "out", kind, rate, note,
        subscribe="viewer", query="viewer", latched=latched, simulated=simulated,
    )  # fmt: skip


def _command(key: str, kind: str, note: str, *, local: bool = False) -> Topic:
    return Topic(key, "in", kind, "any", note, publish="operator", local=local)


def _query(key: str, kind: str, note: str, least: Role | Literal["<role>"] = "viewer") -> Topic:
    return Topic(key, "query", kind, "", note, query=least)


def _service(verb: Verb) -> Topic:
    service = SERVICES[verb]
    return Topic(
        service_key(verb), "service", "ServiceReply", "", service.note, query=service.least
    )


TOPICS: tuple[Topic, ...] = (
    _out("odom", "Odometry", "every feedback", "pose of base in odom, twist, covariances"),
    _out("tf", "TFMessage", "with odom", "transform odom -> base"),
    _out("tf_static", "TFMessage", "latched", "transform base -> lidar", latched=True),
    _out("wheel_states", "JointState", "every feedback", "wheel angles and speeds"),
    _out("battery", "Battery", "1 Hz, on change", "voltage, current and state of charge"),
    _out(
        "cmd_vel_out", "TwistStamped", "every control period",
        "the twist that the daemon applies after all limits",
    ),
    _out("state", "RobotState", "10 Hz, on change", "mode, reason, pose, link, counters"),
    _out("diagnostics", "DiagnosticArray", "1 Hz, on change", "health of every part"),
    _out("events", "Events", "on change", "the last 20 events with time, text and caller"),
    _out(BEAT, "Beat", "20 Hz", "time of the daemon, which a program copies into its commands"),
    _out(
        "sim/pose", "PoseStamped", "100 Hz", "the true pose, only with the simulator",
        simulated=True,
    ),
    _out(
        json_key("<key>"), "JSON", "at the rate of the key",
        "each published key as JSON, for subscribers",
    ),
    _command("cmd/<source>", "Twist or TwistStamped", "velocity command of a source", local=True),
    _command("wheel_cmd/<source>", "JointState", "wheel speeds that a source commands", local=True),
    _command("cmd/<source>/<certificate>", "Twist or TwistStamped", "cmd/<source> over TLS"),
    _command("wheel_cmd/<source>/<certificate>", "JointState", "wheel_cmd/<source> over TLS"),
    # A gyro changes the pose, as set_pose does, so it needs the same role. Clients may subscribe to
    # the gyro of the simulator and query it.
    Topic(
        IMU, "in", "Imu", "any", "turn rate of a gyro; used if `[odometry] gyro = true`",
        publish="maintainer", subscribe="viewer", query="viewer", gyro=True,
    ),
    Topic(
        SPEED_LIMIT, "in", "SpeedLimit", "10 Hz",
        "lowers the highest speed, m/s or %; 0 ends the limit", publish="operator",
    ),
    Topic(
        STOP, "in", "anything", "any", "any PUT stops the robot like srv/stop", publish="viewer",
    ),
    Topic(
        "gateway", "in", "GatewayState", "4 Hz",
        "status of the TLS gateway; only for programs on the robot's machine",
        publish="maintainer", local=True,
    ),
    *(_service(verb) for verb in SERVICES),
    Topic(
        ANY_SERVICE, "service", "ServiceReply", "",
        "refuses a service that this daemon does not have", query="maintainer", local=True,
    ),
    _query("info", "Info", "name, version and settings of the daemon"),
    _query("config", "Config", "the effective configuration", "maintainer"),
    _query("interfaces", "Interfaces", "command and state interfaces"),
    _query("topics", "Topics", "this table"),
    _query(WHOAMI, "WhoAmI", "role of the client that asks; each role has its own key", "<role>"),
    _query("schema/<Type>", "JSON Schema", "the fields of a message type"),
    Topic(
        "alive", "out", "liveliness token", "", "this token exists while the daemon runs",
        subscribe="viewer",
    ),
)  # fmt: skip

# Keys that are published, and the gyro's; not `json/<key>`.
FOLLOWED: tuple[Topic, ...] = tuple(
    topic for topic in TOPICS if topic.subscribe and topic.query and "<" not in topic.key
)

# A query returns the present message.
PUBLISHED: tuple[Topic, ...] = tuple(topic for topic in FOLLOWED if topic.direction == "out")


def offered(config: Config) -> tuple[Topic, ...]:
    """Return the rows of `TOPICS` whose keys exist with this configuration."""
    simulated, gyro = config.mcu.simulated, config.odometry.gyro
    return tuple(
        topic for topic in TOPICS if (simulated or not topic.simulated) and (gyro or not topic.gyro)
    )


def published(config: Config) -> tuple[Topic, ...]:
    """Return the rows of `TOPICS` on which this daemon publishes, the simulated gyro's too."""
    own = config.mcu.simulated
    return tuple(t for t in offered(config) if t in PUBLISHED or (own and t.key == IMU))


def full_key(robot_id: str, key: str) -> str:
    """Return the key on the bus, such as `acsard/acsar/state` for the key `state`."""
    return f"{ROOT_KEY}/{robot_id}/{key}"


COMMANDS = ("cmd", "wheel_cmd")  # first parts of command keys


def command_key(kind: str, source: str, certificate: str = "") -> str:
    """Return the key, below the robot's id, on which a sender puts its commands.

    Over TLS it ends with the certificate's common name, and only this sender may use it.
    """
    return f"{kind}/{source}/{certificate}" if certificate else f"{kind}/{source}"


def source_keys(sources: Iterable[str], certificate: str = "") -> list[str]:
    """Return both command keys of each source; "*" stands for any certificate."""
    names = list(sources)
    return [command_key(kind, name, certificate) for kind in COMMANDS for name in names]


def unknown(key: str) -> bool:
    """Return whether a key matches no row; those of `json/`, `cmd/` and `wheel_cmd/` do."""
    return row_of(key) is None and not key.startswith((JSON_TREE, "cmd/", "wheel_cmd/"))


def key_hint(key: str) -> str:
    """Return a hint for an unknown key: the most similar key, or the advice to list all keys."""
    known = [topic.key for topic in TOPICS if "<" not in topic.key]
    return hint(key, known, "`acsard topics` lists the keys")


def by_key(key: str) -> Topic | None:
    """Return the row whose key is exactly this one, such as `cmd/<source>`, or None."""
    return next((topic for topic in TOPICS if topic.key == key), None)


def row_of(key: str) -> Topic | None:
    """Return the row that describes a key without the robot's id, such as `cmd/app`, or None."""
    return next((topic for topic in TOPICS if _pattern(topic.key).fullmatch(key)), None)


@cache
def _pattern(row: str) -> re.Pattern[str]:
    return re.compile(_PLACE.sub("[^/]+", re.escape(row)))
