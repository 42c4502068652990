"""Makes Zenoh's access rules, default deny, from the table of keys and roles and the ROS names.

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
from acsard.core.messages.permissions import COMMAND_ROLE, Use, has, keys_for, least_role
from acsard.core.messages.topics import (
    IMU,
    Direction,
    full_key,
    json_key,
    offered,
    published,
    source_keys,
)
from acsard.core.ros.transports import PARAMETERS, Endpoint, claims, endpoints, left_out
from acsard.core.values import ROLES, ROOT, Role

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

DRIVERS: tuple[Role, ...] = tuple(role for role in ROLES if has(role, COMMAND_ROLE))
"""The roles whose certificates command."""


def _grants(role: Role) -> tuple[str, ...]:
    """Return the rules of a role: those of its own keys and those of the roles below it.

    A router is a maintainer: it forwards the tokens of other daemons.
    """
    own = [f"{least} {use}" for least in ROLES if has(role, least) for use in USES]
    return ("speak", "tell", *own, *(("appear",) if role == "maintainer" else ()))


USES = ("subscribes", "queries", "publishes")
"""The ends of the names of a role's rules."""

GRANTS: dict[Role, tuple[str, ...]] = {role: _grants(role) for role in ROLES}
"""The rules of each role."""

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
        self._robot, self._sources = robot, [source.name for source in config.commands.sources]
        self._ros = ros = endpoints(config.ros, "*", left_out(config) & {IMU})
        topics, told = offered(config), published(config)
        self._taken = [topic for topic in topics if topic not in told]
        """The rows that clients put on. The simulator publishes its gyro itself."""
        self._given = [*told, *(t for t in self._taken if t.direction != "in")]
        """The rows that clients follow and query."""
        self.all = full_key(robot, "**")
        self.alive = full_key(robot, "alive")
        self.claims = claims(config.ros)
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
        self.commands = [full_key(robot, key) for key in source_keys(self._sources)]
        """Command keys of the listed sources for clients without a certificate."""
        self.questions = [
            full_key(robot, t.pattern)
            for t in topics
            if t.direction == "query" and t.query == "viewer"
        ]
        """Expressions of the queries that every client may send."""
        asked = [full_key(robot, t.pattern) for t in topics if t.direction in ("query", "service")]
        self.answered = [*self.published, *self.kept, *asked]
        self.answered += [e.key for e in ros if e.direction in ("query", "service")]
        """Keys that the daemon publishes on or answers."""

    def of(self, role: Role, use: Use) -> list[str]:
        """Return the exact keys for which `role` is the least role, native and ROS.

        Command keys that end with a certificate are left out; see `commands_by`.
        """
        rows = self._taken if use == "publish" else self._given
        keys = [full_key(self._robot, key) for key in keys_for(role, use, rows)]
        return keys + [e.key for e in self._ros if use in _uses(e) and self._least(e) == role]

    def commands_by(self, certificate: str) -> list[str]:
        """Return the command keys of the listed sources for this certificate, "*" for any."""
        return [full_key(self._robot, key) for key in source_keys(self._sources, certificate)]

    def _least(self, endpoint: Endpoint) -> Role | None:
        """Return the least role for a ROS name: that of the native key that it stands for.

        Commands of a source that is not listed are for nobody. ROS keys have no place for a
        certificate, so they are granted to each role that may command.
        """
        native = endpoint.native
        if native.startswith(PARAMETERS):
            return least_role("config")
        if endpoint.direction == "in" and native != IMU:
            return COMMAND_ROLE if native.rpartition("/")[2] in self._sources else None
        return least_role(native)


def _uses(endpoint: Endpoint) -> tuple[Use, ...]:
    if endpoint.direction == "in":
        return ("publish",)
    return ("subscribe", "query") if endpoint.direction == "out" else ("query",)


def access_control(config: Config) -> dict[str, object]:
    """Return the value of Zenoh's `access_control` for the session of this daemon.

    A TLS link of that session leads to a router. The router lets each client put only on the keys
    of its own certificate, and forwards those samples.
    """
    return _access(config, LOCAL, gateway=False)


def gateway_access(config: Config) -> dict[str, object]:
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
    tokens = [keys.alive, *keys.claims, *keys.kept, *TOKENS]
    # A gyro beside the simulator's is let through, because the code refuses it with a reason.
    forged = [key for key in keys.answered if key != keys.imu]
    following = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"]
    rules = [
        _rule("speak", "egress", SPOKEN, [*keys.answered, *keys.heard, *tokens]),
        _rule("tell", "egress", ["put"], [*keys.published, *keys.kept]),
        _rule("overhear", "egress", ["put"], keys.heard),
    ]
    # exact keys
    for role in ROLES:
        rules += [
            _rule(f"{role} subscribes", "ingress", following, keys.of(role, "subscribe")),
            _rule(f"{role} queries", "ingress", ["query"], keys.of(role, "query")),
            _rule(f"{role} publishes", "ingress", ["put"], keys.of(role, "publish")),
        ]
    rules += [
        _rule("appear", "ingress", ["liveliness_token"], [keys.alive, *keys.claims]),
        _rule("command", "ingress", ["put"], keys.commands),
        _rule("hand_on", "ingress", ["put"], keys.commands_by("*")),
        # with wildcards: all robots at once, the discovery of ROS, samples for late subscribers
        _rule("roam", "ingress", following, [f"{ROOT}/**", *tokens]),
        _rule("recall", "ingress", ["query"], [*keys.kept, *keys.questions]),
        _rule("browse", "ingress", ["query"], [keys.all]),
        _rule("attend", "ingress", ["liveliness_token"], keys.kept),
        # on the robot's own machine
        _rule("look", "ingress", ["declare_subscriber"], ["**"]),
        _rule("err", "ingress", ["put", "delete"], ["**"]),
        _rule("forge", "ingress", ["put", "delete"], [*forged, *tokens], "deny"),
        # between the TLS gateway and the daemon; ** includes no key with an @
        _rule("pass", "both", EVERYTHING, ["**", *tokens]),
    ]
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
