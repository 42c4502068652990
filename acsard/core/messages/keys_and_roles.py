"""The table of all keys below `acsard/<id>/`: direction, type, rate, meaning and required roles.

A key that is not in the table does not exist. The bus declares its keys from this table, and
`permissions.py` derives the permissions of the roles from it. `acsard topics`, the README and the
reply to the query `topics` show the table.
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

Direction = Literal["out", "in", "query", "service"]
"""Direction of a key.

- out: the daemon publishes on the key.
- in: clients put messages on the key.
- query: the daemon answers queries for the key, including queries with a wildcard.
- service: a query for exactly this key calls a service.
"""


class Topic(Struct, frozen=True):
    """One row of the table of keys (`TOPICS`)."""

    key: str
    """The key below the robot's id, with placeholders such as `<source>`."""
    direction: Direction
    type: str
    """Name of the message type in `MESSAGES`. If the type is not in `MESSAGES`, this is a
    description of the type."""
    rate: str
    """How often messages are published or accepted, in words; "" for a query."""
    note: str
    publish: Role | None = None
    """Lowest role that may put on the key. None means that no client may put on it."""
    subscribe: Role | None = None
    """Lowest role that may subscribe to the key. None means that no client may subscribe."""
    query: Role | Literal["<role>"] | None = None
    """Lowest role that may query the key. None means that no client may query it. `<role>` means
    that the last part of the queried key is the lowest role, as in `whoami/operator`."""
    local: bool = False
    """True for a key that only programs on the robot's own machine may use."""
    latched: bool = False
    """True if each new subscriber immediately receives the last message on the key."""
    simulated: bool = False
    """True for a key that exists only with the built-in simulator."""
    gyro: bool = False
    """True for a key that exists only with `[odometry] gyro = true`."""

    @property
    def pattern(self) -> str:
        """The key with each placeholder replaced by a Zenoh wildcard."""
        return _PLACE.sub("*", self.key.replace("<key>", "**"))


class Service(NamedTuple):
    """One row of the table of services (`SERVICES`)."""

    least: Role
    """Lowest role that may call the service."""
    note: str
    payload: str = ""
    """Type of the payload, a name in `MESSAGES`; "" for a service without a payload."""
    example: str = ""
    """An example payload in JSON."""
    optional: bool = False
    """True for a service that may also be called without its payload."""


SERVICES: dict[Verb, Service] = {
    "stop": Service("viewer", "stop the robot; it stays stopped until srv/clear is called"),
    "clear": Service(
        "operator",
        "clear the fault if there is one, else the stop; the payload {latch} names the fault or "
        "stop to release",
        "Release",
        '{"latch": 1800000000000}',
        optional=True,
    ),
    "activate": Service(
        "operator",
        "switch the robot on, so that it follows commands; the payload {latch} names the latch "
        "to release",
        "Release",
        '{"latch": 1800000000000}',
        optional=True,
    ),
    "deactivate": Service(
        "operator", "switch the robot off: it slows down to zero and ignores commands"
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
"""All services, by verb. The bus, ROS, the page and the tools use this table."""

PLAIN_SERVICES = tuple(
    verb for verb, service in SERVICES.items() if service.optional or not service.payload
)
"""The services that can be called without a payload."""

IMU = "imu"
"""Key on which the samples of the gyro arrive, whether the gyro is real or simulated."""

SPEED_LIMIT = "speed_limit"
"""Key on which a client, such as Nav2's speed filter, lowers the robot's highest speed."""

WHOAMI = "whoami/<role>"
"""Pattern of the keys with which a client finds out its role. There is one key for each role.
Zenoh's access rules let a client query only the keys of its own role and of lower roles. So a
client that gets an answer on a key has at least the role of that key."""


def whoami_key(role: str) -> str:
    """Return the key with which a client finds out whether it has the role `role` or a higher one.

    Only clients with such a role can query the key.
    """
    return WHOAMI.replace("<role>", role)


def service_key(verb: str) -> str:
    """Return the key of the service `verb`, such as `srv/stop`."""
    return f"srv/{verb}"


JSON_TREE = "json/"


def json_key(key: str) -> str:
    """Return the key on which the daemon publishes the messages of `key` in JSON."""
    return JSON_TREE + key


VERBS: dict[str, Verb] = {service_key(verb): verb for verb in SERVICES}
"""Maps the key of each service to its verb, such as `srv/stop` to "stop"."""


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
        "stop", "in", "anything", "any", "any PUT stops the robot like srv/stop", publish="viewer",
    ),
    Topic(
        "gateway", "in", "GatewayState", "4 Hz",
        "status of the TLS gateway; only for programs on the robot's machine",
        publish="maintainer", local=True,
    ),
    *(_service(verb) for verb in SERVICES),
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

FOLLOWED: tuple[Topic, ...] = tuple(
    topic for topic in TOPICS if topic.subscribe and topic.query and "<" not in topic.key
)
"""The rows of `TOPICS` for the keys that clients may both subscribe to and query. These are the
keys on which the daemon publishes messages, and the key of the gyro. The row `json/<key>`, which
stands for the JSON copies of all keys, is not included."""

PUBLISHED: tuple[Topic, ...] = tuple(topic for topic in FOLLOWED if topic.direction == "out")
"""The rows of `TOPICS` for the keys on which the daemon publishes messages. A query for such a key
returns the present message. The row `json/<key>`, which stands for the JSON copies of all keys, is
not included."""


def offered(config: Config) -> tuple[Topic, ...]:
    """Return the rows of `TOPICS` whose keys exist on the bus with the configuration `config`.

    `TOPICS` has a row for each Zenoh key. Some keys exist only with the built-in simulator or with
    `[odometry] gyro = true`. The result leaves out the rows whose condition `config` does not
    fulfill.
    """
    simulated, gyro = config.mcu.simulated, config.odometry.gyro
    return tuple(
        topic for topic in TOPICS if (simulated or not topic.simulated) and (gyro or not topic.gyro)
    )


def published(config: Config) -> tuple[Topic, ...]:
    """Return the rows of `TOPICS` for the keys on which this daemon publishes messages.

    `config` is the configuration of the daemon. With the built-in simulator and `odometry.gyro =
    true`, the result includes the key of the gyro, because the daemon publishes the samples of the
    simulated gyro.
    """
    own = config.mcu.simulated
    return tuple(t for t in offered(config) if t in PUBLISHED or (own and t.key == IMU))


def full_key(robot_id: str, key: str) -> str:
    """Return the key on the bus, such as `acsard/acsar/state` for the key `state`."""
    return f"{ROOT_KEY}/{robot_id}/{key}"


COMMANDS = ("cmd", "wheel_cmd")
"""First part of each key on which commands arrive."""


def command_key(kind: str, source: str, certificate: str = "") -> str:
    """Return the key, below the robot's id, on which a sender puts its commands.

    Args:
        kind: the first part of the key, one of `COMMANDS`.
        source: the name of the command source.
        certificate: the common name of the sender's certificate if the sender connects over TLS.
            Only this sender may put on the key. It is "" for a program on the robot's own machine.
    """
    return f"{kind}/{source}/{certificate}" if certificate else f"{kind}/{source}"


def source_keys(sources: Iterable[str], certificate: str = "") -> list[str]:
    """Return the two command keys of each source in `sources`, without the robot's id.

    `certificate` is the common name of the senders' certificate, or "*" for any certificate. It is
    "" for programs on the robot's own machine.
    """
    names = list(sources)
    return [command_key(kind, name, certificate) for kind in COMMANDS for name in names]


def unknown(key: str) -> bool:
    """Return True if `key` matches no row of `TOPICS`. `key` does not contain the robot's id.

    Keys that begin with `json/`, `cmd/` or `wheel_cmd/` always count as known.
    """
    return row_of(key) is None and not key.startswith((JSON_TREE, "cmd/", "wheel_cmd/"))


def key_hint(key: str) -> str:
    """Return a hint for an unknown key: the most similar key, or the advice to list all keys."""
    known = [topic.key for topic in TOPICS if "<" not in topic.key]
    return hint(key, known, "`acsard topics` lists the keys")


def by_key(key: str) -> Topic | None:
    """Return the row of `TOPICS` whose key is exactly `key`, such as `cmd/<source>`, or None."""
    return next((topic for topic in TOPICS if topic.key == key), None)


def row_of(key: str) -> Topic | None:
    """Return the row of `TOPICS` that describes a key, or None.

    `key` is the part after the robot's id. For example, the result for `cmd/app` is the row of
    `cmd/<source>`.
    """
    return next((topic for topic in TOPICS if _pattern(topic.key).fullmatch(key)), None)


@cache
def _pattern(row: str) -> re.Pattern[str]:
    return re.compile(_PLACE.sub("[^/]+", re.escape(row)))
