"""The access rules are those of the permission table, and follow the configuration.

The tests read the rules as Zenoh reads them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from acsard.bus import zenoh_sessions
from acsard.bus.access_rules import access_control, gateway_access
from acsard.bus.zenoh_sessions import gateway_session
from acsard.core.config.settings import (
    AccessConfig,
    CommandsConfig,
    Config,
    McuConfig,
    OdometryConfig,
    RobotConfig,
    RosConfig,
    Source,
)
from acsard.core.messages.keys_and_roles import SERVICES, TOPICS, full_key, whoami_key
from acsard.core.messages.permissions import SERVICE_ROLES
from acsard.core.ros.transports import endpoints
from acsard.core.values import Role
from tests.each import each
from tests.permissions import (
    ANYBODY,
    HERE,
    KEEPERS,
    LEAST,
    VALUES,
    Row,
    by_ros,
    native,
    with_deletes,
)
from tests.promised import PROMISED

ROLES: tuple[Role, ...] = ("viewer", "operator", "maintainer")
EVERYBODY = ("local", *ROLES)
ZID = "0123456789abcdef"
REAL, GYRO = McuConfig(port="/dev/ttyACM0"), OdometryConfig(gyro=True)


class Access:
    """The access rules that follow from one configuration."""

    def __init__(
        self, rules: Callable[[Config], dict[str, object]] = access_control, **tables: Any
    ) -> None:
        self.config = Config(**tables)
        self.value = cast(dict[str, Any], rules(self.config))
        self.rules: dict[str, dict[str, Any]] = {rule["id"]: rule for rule in self.value["rules"]}
        self.subjects = {subject["id"]: subject for subject in self.value["subjects"]}

    def rules_of(self, subject: str) -> list[dict[str, Any]]:
        """Return the rules of a role and of the certificate with the same name."""
        subjects = {subject, f"certificate {subject}"}
        policies = [p for p in self.value["policies"] if subjects & set(p["subjects"])]
        return [self.rules[name] for policy in policies for name in policy["rules"]]

    def lets(self, subject: str, message: str, key: str, flow: str = "ingress") -> bool:
        """Return whether one of the rules allows the message and no rule denies it.

        A rule applies to every key that its key expressions include.
        """
        asked = zenoh.KeyExpr(key)
        permissions = {
            rule["permission"]
            for rule in self.rules_of(subject)
            if flow in rule["flows"] and message in rule["messages"]
            if any(zenoh.KeyExpr(key_expr).includes(asked) for key_expr in rule["key_exprs"])
        }
        return permissions == {"allow"}

    def key(self, below: str) -> str:
        return full_key(self.config.robot.id, below)

    def who(self, message: str, key: str) -> set[str]:
        return {subject for subject in EVERYBODY if self.lets(subject, message, key)}


DEFAULT, GATEWAY = Access(), Access(gateway_access)
TRUSTING = Access(access=AccessConfig(wildcards=True))

# the table

TABLE = with_deletes(row for rows in (native("acsard/acsar"), by_ros()) for row in rows)


def message(row: Row) -> str:
    if row.verb != "subscribe":
        return row.verb
    return "declare_liveliness_subscriber" if row.how == "token" else "declare_subscriber"


@each("role", ROLES)
def test_the_rules_of_a_role_are_the_permission_table(role: Role) -> None:
    wrong = [
        f"{row.verb} {row.key}: {role}"
        for row in TABLE
        if GATEWAY.lets(role, message(row), row.key) != (role in row.who)
    ]
    assert not wrong


@each("topic", [topic for topic in TOPICS if topic.direction != "out"])
def test_the_daemon_hears_and_answers_on_each_key(topic: Any) -> None:
    access = Access(mcu=REAL, odometry=GYRO) if topic.gyro else DEFAULT
    what = "declare_subscriber" if topic.direction == "in" else "declare_queryable"
    for subject in EVERYBODY:
        assert access.lets(subject, what, access.key(topic.pattern), "egress")


def test_the_daemon_publishes_to_everybody() -> None:
    for subject in EVERYBODY:
        for key in map(DEFAULT.key, VALUES):
            assert DEFAULT.lets(subject, "put", key, "egress")
            assert DEFAULT.lets(subject, "reply", key, "egress")
        assert DEFAULT.lets(subject, "reply", DEFAULT.key("tf_static/@adv/**"), "egress")
        assert DEFAULT.lets(subject, "liveliness_token", DEFAULT.key("alive"), "egress")


@pytest.mark.parametrize("role", ROLES)
def test_over_tls_a_role_has_exact_keys_only_and_answers_for_nobody(role: Role) -> None:
    rules = [rule for rule in GATEWAY.rules_of(role) if "ingress" in rule["flows"]]
    assert rules
    assert not [key for rule in rules for key in rule["key_exprs"] if "*" in key]
    messages = {name for rule in rules for name in rule["messages"]}
    assert not messages & {"delete", "reply", "declare_queryable"}


# rules that depend on the configuration


@each("below", ["*", "**", "cmd_v$*", "json/*", "json/**"])
def test_wildcards_are_for_clients_on_the_robot_unless_access_wildcards_is_set(below: str) -> None:
    assert DEFAULT.who("declare_subscriber", DEFAULT.key(below)) == HERE
    assert TRUSTING.who("declare_subscriber", TRUSTING.key(below)) == ANYBODY


def test_with_wildcards_every_role_sees_late_values_and_tokens_but_queries_no_service() -> None:
    keys = [DEFAULT.key("tf_static"), *(e.key for e in endpoints(RosConfig(), ZID) if e.latched)]
    uses = [(what, f"{key}/@adv/**") for key in keys for what in ("query", "declare_subscriber")]
    uses += [(what, "acsard/*/alive") for what in ("declare_liveliness_subscriber",
                                                   "liveliness_query")]  # fmt: skip
    for what, key in uses:
        assert DEFAULT.who(what, key) == HERE
        assert TRUSTING.who(what, key) == ANYBODY
    for key in ("acsard/*/config", "acsard/**", "**", "acsard/*", "0/**", "acsard/other/srv/stop"):
        assert TRUSTING.who("query", key) == set()
    for role in ROLES:
        assert TRUSTING.who("query", TRUSTING.key(whoami_key(role))) == LEAST[role]
    services = [DEFAULT.key(f"srv/{verb}") for verb in SERVICES] + [DEFAULT.key("config")]
    services += [e.key for e in endpoints(RosConfig(), ZID) if e.direction in ("query", "service")]
    for rule in (*TRUSTING.rules_of("viewer"), *TRUSTING.rules_of("operator")):
        if "ingress" in rule["flows"] and "query" in rule["messages"]:
            for key_expr in map(zenoh.KeyExpr, rule["key_exprs"]):
                met = [key for key in services if key_expr.intersects(zenoh.KeyExpr(key))]
                assert met in ([], [str(key_expr)])


def test_over_tls_each_certificate_commands_only_on_its_own_keys() -> None:
    people = AccessConfig(viewers=("wall",), operators=("anna", "ben"), maintainers=("chief",))
    gateway = Access(gateway_access, access=people)
    named = {role: gateway.subjects[role]["cert_common_names"] for role in ROLES}
    assert named == {"viewer": ["wall"], "operator": ["anna", "ben"], "maintainer": ["chief"]}
    for kind in ("cmd", "wheel_cmd"):
        for subject in ("wall", "anna", "ben", "chief", "viewer", "operator", "maintainer"):
            for name in ("anna", "ben", "chief", "wall", "*", "ann$*"):
                own = subject == name and subject != "wall"
                assert gateway.lets(subject, "put", gateway.key(f"{kind}/app/{name}")) == own
            assert not gateway.lets(subject, "put", gateway.key(f"{kind}/app"))


def test_a_gyro_is_put_by_a_maintainer_and_only_if_the_robot_uses_it() -> None:
    for key in (DEFAULT.key("imu"), "imu/data"):
        assert not any(DEFAULT.lets(role, "put", key) for role in ROLES)
        assert Access(mcu=REAL, odometry=GYRO).who("put", key) == KEEPERS
    # with the simulator, received so that the daemon can refuse and report it
    simulated = Access(odometry=GYRO)
    assert simulated.who("put", simulated.key("imu")) == HERE
    assert simulated.who("declare_subscriber", simulated.key("imu")) == ANYBODY


IDS = st.from_regex(r"[A-Za-z0-9_-]{1,32}", fullmatch=True)


@pytest.mark.slow
@given(IDS, IDS)
def test_a_robot_grants_nothing_to_the_clients_of_another_robot(one: str, other: str) -> None:
    access = Access(robot=RobotConfig(id=one), ros=RosConfig(bridge=False, rmw=False))
    for row in native(full_key(other, "").rstrip("/")):
        if one != other:
            assert not any(access.lets(role, message(row), row.key) for role in ROLES), row
    assert access.lets("viewer", "put", full_key(one, "stop"))


@pytest.mark.slow
@given(st.lists(IDS, max_size=5, unique=True))
def test_only_configured_sources_may_send_commands(names: list[str]) -> None:
    sources = tuple(Source(name, priority=1, timeout=0.25) for name in names)
    for rules in (access_control, gateway_access):
        access = Access(rules, commands=CommandsConfig(sources=sources), ros=RosConfig())
        for kind in ("cmd", "wheel_cmd"):
            for name in {"teleop", "app", *names}:
                key = access.key(f"{kind}/{name}/operator")
                assert access.lets("operator", "put", key) == (name in names)
                assert not access.lets("viewer", "put", key)
        assert access.lets("viewer", "put", access.key("stop"))
        for endpoint in endpoints(RosConfig(), ZID):
            if endpoint.native.startswith(("cmd/", "wheel_cmd/")):
                listed = endpoint.native.partition("/")[2] in names
                assert access.lets("operator", "put", endpoint.key) == listed
        zenoh.Config().insert_json5("access_control", json.dumps(access.value))


LEAST_ROLES = {row.key: row.role for row in PROMISED if row.direction != "out" and row.role}


@each("transport", ["bridge", "rmw"])
def test_ros_names_in_a_namespace_are_for_their_least_role_and_of_the_transport_that_is_on(
    transport: str,
) -> None:
    other = "rmw" if transport == "bridge" else "bridge"
    ros = RosConfig(**{other: False}, namespace="robot1")
    access = Access(ros=ros, mcu=REAL, odometry=GYRO)
    uses = {"in": "put", "out": "declare_subscriber", "query": "query", "service": "query"}
    mine = endpoints(ros, ZID)
    assert {endpoint.direction for endpoint in mine} == set(uses)
    for endpoint in mine:
        native = endpoint.native
        usual: Role = "operator" if endpoint.direction == "in" else "maintainer"
        least = "viewer" if endpoint.direction == "out" else LEAST_ROLES.get(native, usual)
        assert access.who(uses[endpoint.direction], endpoint.key) == LEAST[least]
        if endpoint.token:
            assert access.lets("viewer", "liveliness_token", endpoint.token, "egress")
    theirs = {e.key for e in endpoints(RosConfig(namespace="robot1"), ZID) if e.transport == other}
    named = {key for rule in access.rules.values() for key in rule["key_exprs"]}
    assert theirs
    assert not theirs & named


@pytest.mark.parametrize("role", ROLES)
def test_an_empty_list_of_certificates_gives_no_subject(role: Role) -> None:
    """Zenoh would apply a subject without names to every client."""
    access = Access(access=AccessConfig(**{f"{role}s": ()}))  # type: ignore[arg-type]
    assert set(access.subjects) == {*EVERYBODY} - {role}
    assert not any(role in policy["subjects"] for policy in access.value["policies"])


@each(
    "tables",
    [
        {},
        {"ros": RosConfig(bridge=False, rmw=False)},
        {"ros": RosConfig(namespace="a/b", domain=232)},
        {"access": AccessConfig(viewers=(), operators=(), maintainers=())},
        {"robot": RobotConfig(id="x" * 32)},
    ],
)
@each("rules", [access_control, gateway_access])
def test_zenoh_accepts_the_rules(
    tables: dict[str, Any], rules: Callable[[Config], dict[str, object]]
) -> None:
    access = Access(rules, **tables)
    zenoh.Config().insert_json5("access_control", json.dumps(access.value))
    assert (access.value["enabled"], access.value["default_permission"]) == (True, "deny")
    for subject in access.subjects.values():
        if names := subject.get("cert_common_names"):
            assert (subject["link_protocols"], names) == (["tls"], [subject["id"].split()[-1]])
        else:
            assert subject == {"id": "local", "link_protocols": ["tcp"]}
    for policy in access.value["policies"]:
        assert set(policy["rules"]) <= set(access.rules)
        assert set(policy["subjects"]) <= set(access.subjects)
    for rule in access.value["rules"]:
        assert rule["key_exprs"]
        assert len(set(rule["key_exprs"])) == len(rule["key_exprs"])


def test_the_gateway_limits_the_rate_of_all_that_a_client_may_put(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(zenoh_sessions, "_opened", lambda settings, endpoints: settings)
    config = Config(access=AccessConfig(viewers=("v",), operators=("o",), maintainers=("m",)))
    settings: Any = gateway_session(config)
    limited = {rule["key_expr"] for table in settings["downsampling"] for rule in table["rules"]}
    rules = {rule["id"]: rule["key_exprs"] for rule in settings["access_control"]["rules"]}
    for key in (key for role in ROLES for key in rules.get(f"{role} publishes", ())):
        assert key in limited, key
    assert {"acsard/acsar/stop", "stop_request"} <= set(rules["viewer publishes"])


def test_the_daemon_may_do_everything_at_the_gateway() -> None:
    for flow in ("ingress", "egress"):
        for what in ("put", "delete", "query", "reply", "declare_subscriber"):
            for key in ("acsard/acsar/odom", "acsard/acsar/tf_static/@adv/x", "@ros2_lv/0/x", "**"):
                assert GATEWAY.lets("local", what, key, flow)


@each("role", ROLES)
def test_the_page_about_access_names_the_services_of_a_role(role: Role) -> None:
    text = (Path(__file__).parents[2] / "deploy/manual/pages/reference/keys.md").read_text()
    (row,) = re.findall(rf"^\| {role} \| .*$", text, re.M)
    named = {verb for verb in SERVICES if re.search(rf"[`*]{verb}[`*]", row)}
    assert named == {verb for verb, least in SERVICE_ROLES.items() if least == role}
