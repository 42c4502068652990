"""Makes Zenoh's access rules (what none allows is denied) from the keys, roles and ROS names.

The session that accepts a link checks them: the daemon's or, over TLS, the TLS gateway's. It sees
only the certificate at the other end, so a client behind a router has the router's permissions. A
rule must include the whole key expression of a message. Over TLS only exact keys are allowed unless
`access.wildcards` is set: a few wildcards take all of Zenoh's time. Zenoh does not tell the daemon
the sender's certificate, so each certificate has its own command keys, which end with its name. The
daemon checks the exact key, the kind and the source of each command again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypedDict

from acsard.core.config.settings import Config
from acsard.core.messages.keys_and_roles import (
    COMMANDS,
    IMU,
    full_key,
    json_key,
    offered,
    published,
    source_keys,
)
from acsard.core.messages.permissions import COMMAND_ROLE, Use, has, keys_for, least_role
from acsard.core.ros.transports import (
    PARAMETERS_PREFIX,
    Endpoint,
    announced_publishers,
    claims,
    endpoints,
    unused_keys,
)
from acsard.core.values import ROLES, ROOT_KEY, Role

# Messages that a daemon sends, except `put` (data), which has separate rules.
DECLARATIONS = (
    "declare_subscriber",
    "declare_queryable",
    "reply",
    "liveliness_token",
    "declare_liveliness_subscriber",
    "liveliness_query",
)

DRIVERS: tuple[Role, ...] = tuple(role for role in ROLES if has(role, COMMAND_ROLE))

# Names of rules that `_rules` defines.
GRANTS: dict[Role, tuple[str, ...]] = {
    role: (
        "speak",
        "tell",
        *(
            f"{least} {use}"
            for least in ROLES
            if has(role, least)
            for use in ("subscribes", "queries", "publishes")
        ),
        *(("appear",) if role == "maintainer" else ()),
    )
    for role in ROLES
}

# Further rules if `access.wildcards` is true.
WIDE_SUBSCRIPTIONS: dict[Role, tuple[str, ...]] = {
    "viewer": ("roam", "recall"),
    "operator": ("roam", "recall"),
    "maintainer": ("roam", "recall", "browse", "attend"),
}

# A local client may also use any wildcard, and put on any key that the robot does not publish: the
# daemon counts and refuses a command for an unknown source, and says why.
LOCAL_RULES = (
    *GRANTS["maintainer"],
    *WIDE_SUBSCRIPTIONS["maintainer"],
    "command",
    "hand_on",
    "announce",
    "look",
    "overhear",
    "err",
    "forge",
)

Flow = Literal["ingress", "egress"]

Permission = Literal["allow", "deny"]  # for one message, deny wins


class Rule(TypedDict):
    """One rule of Zenoh's `access_control`."""

    id: str
    permission: Permission
    flows: list[Flow]
    messages: list[str]
    key_exprs: list[str]


class _Keys:
    def __init__(self, config: Config) -> None:
        robot = config.robot.id
        self._robot, self._sources = robot, [source.name for source in config.commands.sources]
        self._ros = ros = endpoints(config.ros, "*", unused_keys(config) & {IMU})
        topics, outgoing = offered(config), published(config)
        # The gyro's row is not here with the simulator, because the daemon then publishes its key.
        self._incoming = [topic for topic in topics if topic not in outgoing]
        # Keys that clients may subscribe to or query.
        self._readable = [*outgoing, *(t for t in self._incoming if t.direction != "in")]
        self.all = full_key(robot, "**")
        self.alive = full_key(robot, "alive")
        self.claims = claims(config.ros)
        self.publishers = [tokens for tokens, _, _ in announced_publishers(config)]
        self.imu = full_key(robot, IMU)
        self.published = [full_key(robot, topic.key) for topic in outgoing]
        self.published += [full_key(robot, json_key(topic.key)) for topic in outgoing]
        self.published += [e.key for e in ros if e.direction == "out"]
        latched = [full_key(robot, topic.key) for topic in outgoing if topic.latched]
        latched += [e.key for e in ros if e.latched]
        # Where advanced publishers keep samples for late subscribers.
        self.kept = [f"{key}/@adv/**" for key in latched]
        self.subscribed = [full_key(robot, t.pattern) for t in topics if t.direction == "in"]
        self.subscribed += [e.key for e in ros if e.direction == "in"]
        """Key expressions to which the daemon subscribes."""
        # Command keys for clients that connect without a certificate.
        self.commands = [full_key(robot, key) for key in source_keys(self._sources)]
        # Queries that every client may send.
        self.viewer_queries = [
            full_key(robot, t.pattern)
            for t in topics
            if t.direction == "query" and t.query == "viewer"
        ]
        queries = [
            full_key(robot, t.pattern) for t in topics if t.direction in ("query", "service")
        ]
        self.answered = [*self.published, *self.kept, *queries]
        self.answered += [e.key for e in ros if e.direction in ("query", "service")]
        """Key expressions on which the daemon publishes, or whose queries it answers."""

    def of(self, role: Role, use: Use) -> list[str]:
        """Return the keys that `role` may use and lower roles may not (see `commands_by`)."""
        rows = self._incoming if use == "publish" else self._readable
        keys = [full_key(self._robot, key) for key in keys_for(role, use, rows)]
        return keys + [e.key for e in self._ros if use in _uses(e) and self._least(e) == role]

    def commands_by(self, certificate: str) -> list[str]:
        """Return the command keys of all sources for one certificate.

        "*" stands for every certificate: a router forwards the commands of every client.
        """
        return [full_key(self._robot, key) for key in source_keys(self._sources, certificate)]

    def _least(self, endpoint: Endpoint) -> Role | None:
        # None: the source is not configured, so no role may command.
        native = endpoint.native
        if native.startswith(PARAMETERS_PREFIX):
            return least_role("config")
        # A ROS key cannot contain a certificate's name, so each role that may command may use the
        # ROS command keys of all configured sources.
        if native.startswith(tuple(f"{kind}/" for kind in COMMANDS)):
            return COMMAND_ROLE if native.rpartition("/")[2] in self._sources else None
        return least_role(native)


def _uses(endpoint: Endpoint) -> tuple[Use, ...]:
    if endpoint.direction == "in":
        return ("publish",)
    return ("subscribe", "query") if endpoint.direction == "out" else ("query",)


def access_control(config: Config) -> dict[str, object]:
    """Return Zenoh's `access_control` for the session of the daemon.

    Its TLS links lead to routers, which check the certificate of each client, so the rules let them
    forward the commands of every certificate.
    """
    return _access(config, gateway=False)


def gateway_access(config: Config) -> dict[str, object]:
    """Return Zenoh's `access_control` for the session of the TLS gateway.

    Each role is a subject, and each certificate that may command is one more, for its own command
    keys. The link to the daemon is the only one without a certificate; it carries all messages.
    """
    return _access(config, gateway=True)


def _access(config: Config, *, gateway: bool) -> dict[str, object]:
    keys, access = _Keys(config), config.access
    rules = _rules(keys)
    # Only a link between two programs on this machine needs no certificate, unless `bus.insecure`
    # permits such links to other machines.
    subjects: dict[str, dict[str, list[str]]] = {"local": {"link_protocols": ["tcp"]}}
    granted: dict[str, tuple[str, ...]] = {"local": ("pass",) if gateway else LOCAL_RULES}
    for role, names in access.members.items():
        if names:
            subjects[role] = _over_tls(*names)
        granted[role] = GRANTS[role]
        if access.wildcards:
            granted[role] += WIDE_SUBSCRIPTIONS[role]
        if role in DRIVERS and not gateway:
            granted[role] += ("hand_on",)
    if gateway:
        for name in (name for role in DRIVERS for name in access.members[role]):
            own = _rule(f"command as {name}", "ingress", ["put"], keys.commands_by(name))
            rules.append(own)
            subject = f"certificate {name}"
            subjects[subject], granted[subject] = _over_tls(name), (own["id"],)
    usable = {rule["id"]: rule for rule in rules if rule["key_exprs"]}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": list(usable.values()),
        "subjects": [{"id": name, **subject} for name, subject in subjects.items()],
        "policies": [
            {"rules": allowed, "subjects": [subject]}
            for subject in subjects
            if (allowed := [rule for rule in granted[subject] if rule in usable])
        ],
    }


def _over_tls(*names: str) -> dict[str, list[str]]:
    # Zenoh compares the name of a certificate only on a link that has authenticated the client.
    return {"link_protocols": ["tls"], "cert_common_names": list(names)}


def _rules(keys: _Keys) -> list[Rule]:
    # The last two are the tokens of ROS.
    tokens = [keys.alive, *keys.claims, *keys.kept, "@ros2_lv/**", "@/*/@ros2_lv/**"]
    # The gyro's key is not forbidden, although the daemon of a simulator publishes on it. So the
    # daemon receives a client's sample on this key, and can refuse the sample with a reason.
    forged = [key for key in keys.answered if key != keys.imu]
    following = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"]
    rules = [
        # The daemon sends declarations and answers (`speak`) and data (`tell`). It also forwards
        # commands to clients that subscribe to commands (`overhear`):
        _rule("speak", "egress", DECLARATIONS, [*keys.answered, *keys.subscribed, *tokens]),
        _rule("tell", "egress", ["put"], [*keys.published, *keys.kept]),
        _rule("overhear", "egress", ["put"], keys.subscribed),
    ]
    # Each role may use exact keys:
    for role in ROLES:
        rules += [
            _rule(f"{role} subscribes", "ingress", following, keys.of(role, "subscribe")),
            _rule(f"{role} queries", "ingress", ["query"], keys.of(role, "query")),
            _rule(f"{role} publishes", "ingress", ["put"], keys.of(role, "publish")),
        ]
    return [
        *rules,
        # A router has the role maintainer, and forwards the tokens of other daemons:
        _rule("appear", "ingress", ["liveliness_token"], [keys.alive, *keys.claims]),
        # A ROS publisher of commands announces itself, and then its silence may arm it:
        _rule("announce", "ingress", ["liveliness_token"], keys.publishers),
        # A client without a certificate commands, and a router forwards commands:
        _rule("command", "ingress", ["put"], keys.commands),
        _rule("hand_on", "ingress", ["put"], keys.commands_by("*")),
        # These rules allow wildcards. `roam`: subscribe to all robots and to the tokens of ROS.
        # `recall`: query the samples that are kept for late subscribers, and the keys that viewers
        # may query. `browse`: query all keys of the robot. `attend`: declare the tokens of late
        # subscribers.
        _rule("roam", "ingress", following, [f"{ROOT_KEY}/**", *tokens]),
        _rule("recall", "ingress", ["query"], [*keys.kept, *keys.viewer_queries]),
        _rule("browse", "ingress", ["query"], [keys.all]),
        _rule("attend", "ingress", ["liveliness_token"], keys.kept),
        # The next three rules are only for a client on the robot's own machine (`LOCAL_RULES`).
        _rule("look", "ingress", ["declare_subscriber"], ["**"]),
        _rule("err", "ingress", ["put", "delete"], ["**"]),
        _rule("forge", "ingress", ["put", "delete"], [*forged, *tokens], "deny"),
        # The TLS gateway and the daemon exchange all messages. In Zenoh, `**` does not match a part
        # of a key that begins with @, so the tokens are listed.
        _rule("pass", "both", [*DECLARATIONS, "put", "delete", "query"], ["**", *tokens]),
    ]


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
