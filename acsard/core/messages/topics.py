"""The table of all keys below `acsard/<id>/`, with direction, type, rate and meaning.

The bus declares its keys from this table, the command line and the README list it, and the query
`topics` answers with it. A key that is not in the table does not exist.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from typing import Literal, get_args

from msgspec import Struct

from acsard.core.config.nearest import hint
from acsard.core.config.settings import Config
from acsard.core.values import ROOT, Verb

_PLACE = re.compile("<[A-Za-z]+>")

Direction = Literal["out", "in", "query", "service"]
"""Direction of a topic. A query only reads, and may be asked by a wildcard. A service acts, and
runs only for its exact key.
"""


class Topic(Struct, frozen=True):
    """One row of the table.

    `key` may hold a placeholder: `<source>`, `<certificate>`, `<Type>`, `<key>` or `<role>`.
    """

    key: str
    direction: Direction
    type: str
    rate: str
    note: str
    latched: bool = False
    simulated: bool = False
    """True for a key that exists only with the built-in simulator."""
    gyro: bool = False
    """True for a key that exists only with `[odometry] gyro = true`."""

    @property
    def pattern(self) -> str:
        """The key with each placeholder replaced by a Zenoh wildcard."""
        return _PLACE.sub("*", self.key.replace("<key>", "**"))


SERVICES: tuple[Verb, ...] = get_args(Verb)

_SERVICE_NOTES: dict[Verb, str] = {
    "stop": "stop, and stay stopped until clear",
    "clear": "clear the fault if there is one, else the stop; the payload {latch} names it",
    "activate": "switch on, so that commands count; the payload {latch} names the latch",
    "deactivate": "switch off: ramp to zero and ignore commands",
    "reset_odometry": "set the pose to x 0, y 0, yaw 0",
    "set_pose": "set the pose to the payload {x, y, yaw}",
    "set": "change settings; the payload is {settings: {key: value}}",
}


IMU = "imu"
"""Key of the gyro's samples. The simulator publishes its own gyro on the same key."""


WHOAMI = "whoami/<role>"
"""One key for each role. Zenoh's access rules let a client query only the keys of its own role
and of lower ones, so an answer proves the role.
"""


def whoami_key(role: str) -> str:
    """Return the key that answers clients with at least this role."""
    return WHOAMI.replace("<role>", role)


def service_key(verb: str) -> str:
    """Return the key of a service."""
    return f"srv/{verb}"


JSON_TREE = "json/"


def json_key(key: str) -> str:
    """Return the key on which a published topic also appears in JSON."""
    return JSON_TREE + key


VERBS: dict[str, Verb] = {service_key(verb): verb for verb in SERVICES}
"""The verb of each service, by its key."""

TOPICS: tuple[Topic, ...] = (
    Topic("odom", "out", "Odometry", "every feedback", "pose, twist, covariance of base in odom"),
    Topic("tf", "out", "TFMessage", "with odom", "transform odom -> base"),
    Topic("tf_static", "out", "TFMessage", "latched", "transform base -> lidar", latched=True),
    Topic("wheel_states", "out", "JointState", "every feedback", "wheel angles and speeds"),
    Topic("cmd_vel_out", "out", "TwistStamped", "every period", "the twist applied after limits"),
    Topic("state", "out", "RobotState", "10 Hz, on change", "mode, reason, pose, link, counters"),
    Topic("diagnostics", "out", "DiagnosticArray", "1 Hz, on change", "health of every part"),
    Topic("events", "out", "Events", "on change", "the last 20 events with time, text and caller"),
    Topic(
        "sim/pose", "out", "PoseStamped", "100 Hz", "the true pose, simulated only", simulated=True
    ),
    Topic(
        json_key("<key>"), "out", "JSON", "as the key", "each key above as JSON, for subscribers"
    ),
    Topic("cmd/<source>", "in", "Twist or TwistStamped", "any", "velocity command of a source"),
    Topic("wheel_cmd/<source>", "in", "JointState", "any", "four wheel speeds of a source"),
    Topic(
        "cmd/<source>/<certificate>", "in", "Twist or TwistStamped", "any", "cmd/<source> over TLS"
    ),
    Topic(
        "wheel_cmd/<source>/<certificate>", "in", "JointState", "any", "wheel_cmd/<source> over TLS"
    ),
    Topic(IMU, "in", "Imu", "any", "turn rate from a gyro, with [odometry] gyro", gyro=True),
    Topic("stop", "in", "anything", "any", "any PUT stops the robot like srv/stop"),
    Topic("door", "in", "DoorState", "4 Hz", "status of the TLS gateway, on this machine only"),
    *(Topic(key, "service", "ServiceReply", "", _SERVICE_NOTES[v]) for key, v in VERBS.items()),
    Topic("info", "query", "Info", "", "name, version and settings of the daemon"),
    Topic("config", "query", "Config", "", "the effective configuration"),
    Topic("interfaces", "query", "Interfaces", "", "command and state interfaces"),
    Topic("topics", "query", "Topics", "", "this table"),
    Topic(WHOAMI, "query", "WhoAmI", "", "role of the client that asks, one key per role"),
    Topic("schema/<Type>", "query", "JSON Schema", "", "the fields of a message type"),
    Topic("alive", "out", "liveliness token", "", "present while the daemon runs"),
)

PUBLISHED: tuple[Topic, ...] = tuple(
    topic
    for topic in TOPICS
    if topic.direction == "out" and topic.key not in ("alive", json_key("<key>"))
)
"""The topics with a payload. Each also answers queries with its last value."""


def offered(config: Config) -> tuple[Topic, ...]:
    """Return the rows that a daemon with this configuration has."""
    simulated, gyro = config.mcu.simulated, config.odometry.gyro
    rows = (topic for topic in TOPICS if simulated or not topic.simulated)
    return tuple(topic for topic in rows if gyro or not topic.gyro)


def published(config: Config) -> tuple[Topic, ...]:
    """Return the rows that a daemon with this configuration publishes.

    The simulator also publishes its gyro.
    """
    own = config.mcu.simulated
    return tuple(t for t in offered(config) if t in PUBLISHED or (own and t.key == IMU))


def full_key(robot_id: str, key: str) -> str:
    """Return the complete key on the bus."""
    return f"{ROOT}/{robot_id}/{key}"


COMMANDS = ("cmd", "wheel_cmd")
"""First part of each key on which commands arrive."""


def command_key(kind: str, source: str, certificate: str = "") -> str:
    """Return the key that a source commands on.

    `certificate` is the common name of the sender's certificate. Over TLS each certificate has a
    key of its own, and the access rules let no other certificate put there. Without a certificate
    the key is that of programs on the robot's own machine.
    """
    return f"{kind}/{source}/{certificate}" if certificate else f"{kind}/{source}"


def source_keys(sources: Iterable[str], certificate: str = "") -> list[str]:
    """Return the keys on which these sources command; `certificate` may be "*" for all of them."""
    names = list(sources)
    return [command_key(kind, name, certificate) for kind in COMMANDS for name in names]


def unknown(key: str) -> bool:
    """Return whether no row of the table matches the key.

    Keys below `json/`, `cmd/` and `wheel_cmd/` count as known, because they depend on the
    configuration.
    """
    return row_of(key) is None and not key.startswith((JSON_TREE, "cmd/", "wheel_cmd/"))


def key_hint(key: str) -> str:
    """Return the most similar key of the table, or the advice to list them."""
    known = [topic.key for topic in TOPICS if "<" not in topic.key]
    return hint(key, known, "`acsard topics` lists the keys")


def by_key(key: str) -> Topic | None:
    """Return the row whose key is written exactly like this in the table, or None."""
    return next((topic for topic in TOPICS if topic.key == key), None)


def row_of(key: str) -> Topic | None:
    """Return the row that matches a key below the robot's id, as `cmd/app` matches
    `cmd/<source>`.
    """
    found = (topic for topic in TOPICS if _like(topic.key).fullmatch(key))
    return next(found, None)


@cache
def _like(row: str) -> re.Pattern[str]:
    return re.compile(_PLACE.sub("[^/]+", re.escape(row)))
