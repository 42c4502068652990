"""Makes Zenoh's access rules, default deny, from the topic table, the ROS names and the roles.

- Zenoh checks the rules at the end of a link: at the daemon's session or, over TLS, at the session
  of the TLS gateway. It sees only the neighbour on that link, so a client behind a router has the
  rights of the router.
- A rule holds for each key expression that it includes. A query with a wildcard therefore needs a
  rule with a wildcard.
- A client over TLS gets exact keys only, because a few wildcards can take Zenoh's time without
  bound.
- The daemon checks each message again in code: exact key, kind PUT, listed source.

Zenoh does not tell the daemon which certificate a sample came with. The rules do it instead: each
certificate that commands has keys of its own, which end with its name.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypedDict

from acsard.core.config.settings import Config
from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.topics import (
    IMU,
    VERBS,
    Direction,
    full_key,
    json_key,
    offered,
    published,
    service_key,
    source_keys,
    whoami_key,
)
from acsard.core.ros.transports import Endpoint, claims, endpoints, left_out
from acsard.core.values import ROLES, ROOT, Role, Verb

SERVICE_ROLES: dict[Verb, Role] = {
    "stop": "viewer",
    "clear": "operator",
    "activate": "operator",
    "deactivate": "operator",
    "reset_odometry": "operator",
    "set_pose": "maintainer",
    "set": "maintainer",
}
"""The least role that may call each service. Every client that sees the robot may stop it."""

MAY: dict[Role, str] = {
    "viewer": "it may follow and stop, not drive",
    "operator": "it may drive by the listed sources, stop and clear",
    "maintainer": "it has every permission",
}
"""What each role may do, for the message of a tool that was refused."""

LOCAL_LINKS = ("tcp",)
"""Links without a certificate. They do not leave the machine unless `bus.insecure` lets them."""

TOKENS = ("@ros2_lv/**", "@/*/@ros2_lv/**")
"""The liveliness tokens of the ROS trees."""

SPOKEN = (
    "declare_subscriber",
    "declare_queryable",
    "reply",
    "liveliness_token",
    "declare_liveliness_subscriber",
    "liveliness_query",
)
"""The messages that a daemon sends by itself: data, answers and its declarations."""

EVERYTHING = (*SPOKEN, "put", "delete", "query")

GRANTS: dict[Role, tuple[str, ...]] = {
    "viewer": ("speak", "tell", "watch", "ask", "halt"),
    "operator": ("speak", "tell", "watch", "ask", "halt", "drive", "operate"),
    "maintainer": (
        "speak",
        "tell",
        "watch",
        "appear",
        "ask",
        "halt",
        "drive",
        "operate",
        "maintain",
        "sense",
    ),
}
"""The rules of each role. A router is a maintainer: it forwards the tokens of other daemons."""

DRIVERS: tuple[Role, ...] = ("operator", "maintainer")
"""The roles whose certificates command."""

WIDE: dict[Role, tuple[str, ...]] = {
    "viewer": ("roam", "recall"),
    "operator": ("roam", "recall"),
    "maintainer": ("roam", "recall", "browse", "attend"),
}
"""The rules that `access.wildcards` adds to each role."""

LOCAL = (
    *GRANTS["maintainer"],
    *WIDE["maintainer"],
    "command",
    "hand_on",
    "look",
    "overhear",
    "err",
    "forge",
)
"""The rules of a client on the robot's own machine.

It may also subscribe with any wildcard, receive commands, and put on wrong keys, which the daemon
refuses with a reason and counts. It may not publish in the robot's place.
"""

Flow = Literal["ingress", "egress"]

Permission = Literal["allow", "deny"]
"""Where both hold, Zenoh denies."""


class Rule(TypedDict):
    """One rule of Zenoh's `access_control`."""

    id: str
    permission: Permission
    flows: list[Flow]
    messages: list[str]
    key_exprs: list[str]


class _Keys:
    """The keys of one robot, native and ROS, grouped by their use."""

    def __init__(self, config: Config) -> None:
        robot = config.robot.id
        self._robot, self._ros = robot, endpoints(config.ros, "*", left_out(config) & {IMU})
        ros, topics, told = self._ros, offered(config), published(config)
        self.all = full_key(robot, "**")
        self.alive = full_key(robot, "alive")
        self.claims = claims(config.ros)
        self.config = full_key(robot, "config")
        self.stop = full_key(robot, "stop")
        self.imu = full_key(robot, IMU)
        self.published = [full_key(robot, topic.key) for topic in told]
        self.published += [full_key(robot, json_key(topic.key)) for topic in told]
        self.published += _of(ros, "out")
        latched = [full_key(robot, topic.key) for topic in told if topic.latched]
        latched += [e.key for e in ros if e.latched]
        self.kept = [f"{key}/@adv/**" for key in latched]
        """Keys under which Zenoh's advanced publishers keep samples for late subscribers."""
        self.heard = [full_key(robot, t.pattern) for t in topics if t.direction == "in"]
        self.heard += _of(ros, "in")
        """Keys that the daemon subscribes to, for each sender."""
        sources = [source.name for source in config.commands.sources]
        self.commands = [full_key(robot, key) for key in source_keys(sources)]
        """Command keys of the listed sources for clients without a certificate."""
        self.ros_commands = [
            e.key for e in ros if e.direction == "in" and e.native.rpartition("/")[2] in sources
        ]
        """Command keys of the listed sources in ROS, which have no place for a certificate."""
        self._sources = sources
        self.gyro = [full_key(robot, t.key) for t in topics if t.key == IMU and t not in told]
        self.gyro += [e.key for e in ros if e.native == IMU]
        """Keys on which a gyro sends; none with the simulator, which has a gyro of its own."""
        asked = [full_key(robot, t.pattern) for t in topics if t.direction == "query"]
        self.whoami = {role: full_key(robot, whoami_key(role)) for role in ROLES}
        """Each role may query its own key and those of lower roles, so the highest key that answers
        is the role of the client."""
        self.any_role = full_key(robot, whoami_key("*"))
        own = (self.config, self.any_role)
        self.questions = [key for key in asked if key not in own]
        self.exact_questions = [key for key in self.questions if "*" not in key]
        self.exact_questions += [full_key(robot, f"schema/{name}") for name in SCHEMAS]
        self.parameters = _of(ros, "query")

    def commands_by(self, certificate: str) -> list[str]:
        """Return the command keys of the listed sources for this certificate, "*" for any."""
        return [full_key(self._robot, key) for key in source_keys(self._sources, certificate)]

    def of(self, verb: Verb) -> list[str]:
        """Return the keys of a service, native and ROS."""
        native = service_key(verb)
        return [full_key(self._robot, native)] + [e.key for e in self._ros if e.native == native]


def least_role(key: str) -> Role:
    """Return the least role that may use a key below the robot's id."""
    verb = VERBS.get(key)
    if verb is not None:
        return SERVICE_ROLES[verb]
    if key.startswith(("cmd/", "wheel_cmd/")):
        return "operator"
    return "maintainer" if key in ("config", IMU) else "viewer"


def access_control(config: Config) -> dict[str, object]:
    """Return the value of Zenoh's `access_control` for the session of this daemon.

    A TLS link of that session leads to a router. The router lets each client put only on the keys
    of its own certificate, and forwards those samples.
    """
    return _access(config, LOCAL, gateway=False)


def door_access(config: Config) -> dict[str, object]:
    """Return the value of `access_control` for the TLS gateway's session.

    Its only link without a certificate is that to the daemon. Each certificate that may command has
    a subject of its own beside the subject of its role.
    """
    return _access(config, ("pass",), gateway=True)


def _access(config: Config, local: tuple[str, ...], *, gateway: bool) -> dict[str, object]:
    keys = _Keys(config)
    rules = _rules(keys)
    access = config.access
    names: dict[Role, tuple[str, ...]] = {
        "viewer": access.viewers,
        "operator": access.operators,
        "maintainer": access.maintainers,
    }
    # Zenoh compares the name of a certificate only on a link that it authenticated.
    subjects: dict[str, dict[str, list[str]]] = {"local": {"link_protocols": list(LOCAL_LINKS)}}
    subjects |= {
        role: {"link_protocols": ["tls"], "cert_common_names": list(held)}
        for role, held in names.items()
        if held
    }
    wide = WIDE if access.wildcards else dict.fromkeys(GRANTS, ())
    granted: dict[str, tuple[str, ...]] = {"local": local}
    granted |= {role: (*GRANTS[role], *wide[role]) for role in GRANTS}
    drivers = [name for role in DRIVERS for name in names[role]]
    if gateway:
        for name in drivers:
            own = _rule(f"command as {name}", "ingress", ["put"], keys.commands_by(name))
            rules[own["id"]] = own
            subject = f"certificate {name}"
            subjects[subject] = {"link_protocols": ["tls"], "cert_common_names": [name]}
            granted[subject] = (own["id"],)
    else:
        for role in DRIVERS:
            granted[role] += ("hand_on",)
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for rule in rules.values() if rule["key_exprs"]],
        "subjects": [{"id": name, **subject} for name, subject in subjects.items()],
        "policies": [
            {
                "rules": [rule for rule in granted[name] if rules[rule]["key_exprs"]],
                "subjects": [name],
            }
            for name in subjects
            if any(rules[rule]["key_exprs"] for rule in granted[name])
        ],
    }


def _rules(keys: _Keys) -> dict[str, Rule]:
    def services(role: Role) -> list[str]:
        return [k for verb, least in SERVICE_ROLES.items() if least == role for k in keys.of(verb)]

    tokens = [keys.alive, *keys.claims, *keys.kept, *TOKENS]
    answered = [*keys.published, *keys.kept, *keys.questions, keys.config, *keys.parameters]
    answered.append(keys.any_role)
    answered += [key for verb in SERVICE_ROLES for key in keys.of(verb)]
    # A gyro beside the simulator's is let through, because the code refuses it with a reason.
    forged = [key for key in answered if key != keys.imu]
    watching = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"]
    asked = [*keys.published, *keys.exact_questions, *services("viewer"), keys.whoami["viewer"]]
    operated = [*services("operator"), keys.whoami["operator"]]
    maintained = [*services("maintainer"), keys.whoami["maintainer"], keys.config]
    maintained += keys.parameters
    rules = (
        _rule("speak", "egress", SPOKEN, [*answered, *keys.heard, *tokens]),
        _rule("tell", "egress", ["put"], [*keys.published, *keys.kept]),
        _rule("overhear", "egress", ["put"], keys.heard),
        # exact keys
        _rule("watch", "ingress", watching, [*keys.published, keys.alive]),
        _rule("appear", "ingress", ["liveliness_token"], [keys.alive, *keys.claims]),
        _rule("ask", "ingress", ["query"], asked),
        _rule("halt", "ingress", ["put"], [keys.stop]),
        _rule("command", "ingress", ["put"], keys.commands),
        _rule("hand_on", "ingress", ["put"], keys.commands_by("*")),
        _rule("drive", "ingress", ["put"], keys.ros_commands),
        _rule("operate", "ingress", ["query"], operated),
        _rule("maintain", "ingress", ["query"], maintained),
        # A gyro changes the pose, as set_pose does, so it needs the same role.
        _rule("sense", "ingress", ["put"], keys.gyro),
        # with wildcards: all robots at once, the discovery of ROS, samples for late subscribers
        _rule("roam", "ingress", watching, [f"{ROOT}/**", *tokens]),
        _rule("recall", "ingress", ["query"], [*keys.kept, *keys.questions]),
        _rule("browse", "ingress", ["query"], [keys.all]),
        _rule("attend", "ingress", ["liveliness_token"], keys.kept),
        # on the robot's own machine
        _rule("look", "ingress", ["declare_subscriber"], ["**"]),
        _rule("err", "ingress", ["put", "delete"], ["**"]),
        _rule("forge", "ingress", ["put", "delete"], [*forged, *tokens], "deny"),
        # between the TLS gateway and the daemon; ** includes no key with an @
        _rule("pass", "both", EVERYTHING, ["**", *tokens]),
    )
    return {rule["id"]: rule for rule in rules}


def _rule(
    name: str,
    flow: Flow | Literal["both"],
    messages: Sequence[str],
    keys: Sequence[str],
    permission: Permission = "allow",
) -> Rule:
    return {
        "id": name,
        "permission": permission,
        "flows": ["ingress", "egress"] if flow == "both" else [flow],
        "messages": list(messages),
        "key_exprs": list(dict.fromkeys(keys)),
    }


def _of(ros: Sequence[Endpoint], direction: Direction) -> list[str]:
    return [e.key for e in ros if e.direction == direction]
