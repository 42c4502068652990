"""Tests of the access rules: which role may send which message on which key.

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
from msgspec import structs

from acsard.bus.access import GRANTS, _Keys, access_control, gateway_access
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
from acsard.core.messages.keys_and_roles import (
    PUBLISHED,
    SERVICES,
    TOPICS,
    WHOAMI,
    full_key,
    json_key,
    whoami_key,
)
from acsard.core.messages.permissions import SERVICE_ROLES, least_role
from acsard.core.ros.transports import PARAMETERS_PREFIX, claims, endpoints
from acsard.core.values import Role
from tests.each import each
from tests.promised import PROMISED

ROLES: tuple[Role, ...] = ("viewer", "operator", "maintainer")
EVERYBODY = ("local", *ROLES)
ZID = "0123456789abcdef"


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
REAL, GYRO = McuConfig(port="/dev/ttyACM0"), OdometryConfig(gyro=True)
SENSING = Access(mcu=REAL, odometry=GYRO)
TRUSTING = Access(access=AccessConfig(wildcards=True))
FROM: dict[Role, set[str]] = {
    "viewer": {"viewer", "operator", "maintainer", "local"},
    "operator": {"operator", "maintainer", "local"},
    "maintainer": {"maintainer", "local"},
}
"""Maps a role to every subject that has at least this role."""


def written(key: str) -> str:
    """Return a key of the table with real names in place of its placeholders."""
    key = key.replace("<source>", "app").replace("<certificate>", "anna")
    return key.replace("<Type>", "Twist").replace("<role>", "operator")


# the roles


def test_each_role_has_all_permissions_of_the_role_below_it_and_more() -> None:
    for less, more in (("viewer", "operator"), ("operator", "maintainer"), ("maintainer", "local")):
        given_less = {rule["id"] for rule in DEFAULT.rules_of(less)}
        given_more = {rule["id"] for rule in DEFAULT.rules_of(more)}
        forbidden = {name for name in given_more if DEFAULT.rules[name]["permission"] == "deny"}
        assert given_less < given_more - forbidden
    assert set(GRANTS) == set(ROLES)


def test_every_service_has_a_role_and_every_role_has_a_service() -> None:
    assert set(SERVICE_ROLES) == set(SERVICES)
    assert set(SERVICE_ROLES.values()) == set(ROLES)


def test_a_message_that_no_rule_allows_is_denied() -> None:
    assert DEFAULT.value["enabled"] is True
    assert DEFAULT.value["default_permission"] == "deny"


def test_a_certificate_counts_only_over_tls_and_a_tcp_link_needs_none() -> None:
    assert DEFAULT.subjects["local"] == {"id": "local", "link_protocols": ["tcp"]}
    for role in ROLES:
        subject = DEFAULT.subjects[role]
        assert subject["link_protocols"] == ["tls"]
        assert subject["cert_common_names"] == [role]


def test_every_policy_names_rules_and_subjects_that_exist() -> None:
    for policy in DEFAULT.value["policies"]:
        assert set(policy["rules"]) <= set(DEFAULT.rules)
        assert set(policy["subjects"]) <= set(DEFAULT.subjects)


# the native keys


TOLD = [key for topic in PUBLISHED for key in (topic.key, f"json/{topic.key}")]


@each("key_suffix", TOLD)
def test_every_role_may_subscribe_to_and_query_the_published_keys(key_suffix: str) -> None:
    key = DEFAULT.key(key_suffix)
    assert DEFAULT.who("declare_subscriber", key) == FROM["viewer"]
    assert DEFAULT.who("query", key) == FROM["viewer"]
    for subject in EVERYBODY:
        assert DEFAULT.lets(subject, "put", key, "egress")
        assert DEFAULT.lets(subject, "reply", key, "egress")


@each("below", ["*", "**", "cmd_v$*", "json/*", "json/**"])
def test_wildcards_are_for_clients_on_the_robot_unless_access_wildcards_is_set(below: str) -> None:
    assert DEFAULT.who("declare_subscriber", DEFAULT.key(below)) == {"local"}
    assert TRUSTING.who("declare_subscriber", TRUSTING.key(below)) == FROM["viewer"]


@pytest.mark.parametrize("role", ROLES)
def test_a_client_over_tls_may_use_exact_keys_only(role: Role) -> None:
    rules = [rule for rule in GATEWAY.rules_of(role) if "ingress" in rule["flows"]]
    named = [key for rule in rules for key in rule["key_exprs"]]
    assert named
    assert not [key for key in named if "*" in key]


def test_over_tls_each_certificate_commands_only_on_its_own_keys() -> None:
    people = AccessConfig(viewers=("wall",), operators=("anna", "ben"), maintainers=("chief",))
    gateway = Access(gateway_access, access=people)
    for kind in ("cmd", "wheel_cmd"):
        for subject in ("wall", "anna", "ben", "chief", "viewer", "operator", "maintainer"):
            for name in ("anna", "ben", "chief", "wall", "*", "ann$*"):
                own = subject == name and subject != "wall"
                assert gateway.lets(subject, "put", gateway.key(f"{kind}/app/{name}")) == own
            assert not gateway.lets(subject, "put", gateway.key(f"{kind}/app"))


def test_a_router_forwards_the_commands_of_any_certificate_and_no_command_without_one() -> None:
    for role in ("operator", "maintainer"):
        assert DEFAULT.lets(role, "put", DEFAULT.key("cmd/app/anna"))
        assert not DEFAULT.lets(role, "put", DEFAULT.key("cmd/ghost/anna"))
        assert not DEFAULT.lets(role, "put", DEFAULT.key("cmd/app"))
    assert not DEFAULT.lets("viewer", "put", DEFAULT.key("cmd/app/anna"))


LEAST = {row.key: row.role for row in PROMISED if row.direction != "out" and row.role}


@each("topic", [t for t in TOPICS if t.direction != "out"])
def test_every_other_key_is_for_its_least_role_and_the_roles_above(topic: Any) -> None:
    access = SENSING if topic.gyro else DEFAULT
    key = access.key(written(topic.key))
    message = "put" if topic.direction == "in" else "query"
    allowed = FROM[LEAST[topic.key]] if topic.key in LEAST else {"local"}
    assert access.who(message, key) == allowed
    declared = "declare_subscriber" if topic.direction == "in" else "declare_queryable"
    for subject in EVERYBODY:
        assert access.lets(subject, declared, access.key(topic.pattern), "egress")


@pytest.mark.parametrize("access", [DEFAULT, TRUSTING], ids=["exact", "wildcards"])
def test_a_role_may_query_only_the_whoami_keys_of_its_own_and_lower_roles(access: Access) -> None:
    for role in ROLES:
        clients = access.who("query", access.key(whoami_key(role)))
        assert clients == FROM[role]
    assert access.who("query", access.key("whoami/*")) <= FROM["maintainer"]


def test_the_rules_have_the_least_role_of_each_key() -> None:
    for topic in TOPICS:
        if topic.direction != "out" and topic.key in LEAST and topic.key != WHOAMI:
            assert least_role(written(topic.key)) == LEAST[topic.key]
        elif topic.direction == "out" and topic.key != json_key("<key>"):
            assert least_role(topic.key) == "viewer"


def test_a_ros_key_without_a_native_key_is_granted_to_no_role() -> None:
    keys, (endpoint, *_) = _Keys(Config()), endpoints(Config().ros, "*")
    assert keys._least(endpoint)
    with pytest.raises(LookupError, match="no row for 'forgotten'"):
        keys._least(structs.replace(endpoint, native="forgotten"))


def test_an_unused_gyro_key_is_granted_to_no_role() -> None:
    for key in (DEFAULT.key("imu"), "imu/data"):
        assert not any(DEFAULT.lets(role, "put", key) for role in ROLES)


def test_only_a_local_client_may_put_on_the_simulated_gyro() -> None:
    simulated = Access(odometry=GYRO)
    # received so that the daemon can refuse and report it
    assert simulated.who("put", simulated.key("imu")) == {"local"}
    assert simulated.who("declare_subscriber", simulated.key("imu")) == FROM["viewer"]


def test_every_role_sees_that_the_robot_is_alive() -> None:
    for message in ("declare_liveliness_subscriber", "liveliness_query"):
        assert DEFAULT.who(message, DEFAULT.key("alive")) == FROM["viewer"]
        assert DEFAULT.who(message, "acsard/*/alive") == {"local"}
        assert TRUSTING.who(message, "acsard/*/alive") == FROM["viewer"]
    for subject in EVERYBODY:
        assert DEFAULT.lets(subject, "liveliness_token", DEFAULT.key("alive"), "egress")


def test_a_router_may_forward_tokens_of_another_daemon_with_this_id_or_these_ros_names() -> None:
    for token in (DEFAULT.key("alive"), *claims(RosConfig())):
        assert DEFAULT.who("liveliness_token", token) == FROM["maintainer"]
        assert DEFAULT.lets("maintainer", "declare_liveliness_subscriber", token, "egress")


def test_a_late_subscriber_gets_the_kept_static_transforms() -> None:
    ros = endpoints(RosConfig(), ZID)
    for key in (DEFAULT.key("tf_static"), *(e.key for e in ros if e.latched)):
        for message in ("query", "declare_subscriber"):
            assert DEFAULT.who(message, f"{key}/@adv/**") == {"local"}
            assert TRUSTING.who(message, f"{key}/@adv/**") == FROM["viewer"]
        for subject in EVERYBODY:
            assert DEFAULT.lets(subject, "reply", f"{key}/@adv/**", "egress")


# no wildcard gets around the rules


@pytest.mark.parametrize("role", ROLES)
def test_no_role_may_delete_or_answer_in_the_robots_place(role: Role) -> None:
    messages = {m for r in DEFAULT.rules_of(role) if "ingress" in r["flows"] for m in r["messages"]}
    assert not messages & {"delete", "reply", "declare_queryable"}


@pytest.mark.parametrize("role", ROLES)
def test_no_role_may_put_by_wildcard_or_on_what_the_robot_publishes(role: Role) -> None:
    below = [
        "*",
        "**",
        "cmd/*",
        "cmd/**",
        "wheel_cmd/*",
        "cmd/a$*",
        "stop/**",
        "*/app",
        "cmd/ghost",
        "cmd/app",
        "cmd/app/**",
        "cmd/*/anna",
    ]
    below += ["json/*", "json/**", *TOLD]
    for key in (*map(DEFAULT.key, below), "acsard/*/cmd/app", "acsard/**", "**"):
        assert not DEFAULT.lets(role, "put", key), key


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_no_wildcard_covers_a_service_for_less_than_a_maintainer(role: Role) -> None:
    """No rule of a lower role allows a query on a wildcard that matches a service."""
    services = [DEFAULT.key(f"srv/{verb}") for verb in SERVICES] + [DEFAULT.key("config")]
    services += [e.key for e in endpoints(RosConfig(), ZID) if e.direction in ("query", "service")]
    for rule in TRUSTING.rules_of(role):
        if "ingress" in rule["flows"] and "query" in rule["messages"]:
            for key_expr in map(zenoh.KeyExpr, rule["key_exprs"]):
                met = [
                    service for service in services if key_expr.intersects(zenoh.KeyExpr(service))
                ]
                assert met in ([], [str(key_expr)])


def test_not_even_a_maintainer_may_query_beyond_the_robots_own_keys() -> None:
    for key in ("acsard/*/config", "acsard/**", "**", "acsard/*", "0/**", "acsard/other/srv/stop"):
        assert DEFAULT.who("query", key) == TRUSTING.who("query", key) == set()


@each("role", ROLES)
@each(
    "key", ["acsard/other/stop", "acsard/other/cmd/app", "acsard/acsard/stop", "other/cmd_vel", "x"]
)
def test_nothing_outside_the_robots_own_keys_is_granted(role: Role, key: str) -> None:
    for message in ("put", "query", "delete", "reply"):
        assert not DEFAULT.lets(role, message, key)
        assert not DEFAULT.lets(role, message, key, "egress")


IDS = st.from_regex(r"[A-Za-z0-9_-]{1,32}", fullmatch=True)


@pytest.mark.slow
@given(IDS, IDS)
def test_a_robot_grants_nothing_to_the_clients_of_another_robot(one: str, other: str) -> None:
    access = Access(robot=RobotConfig(id=one), ros=RosConfig(bridge=False, rmw=False))
    for topic in TOPICS:
        message = "put" if topic.direction == "in" else "query"
        key = full_key(other, written(topic.key))
        if one != other:
            assert not any(access.lets(role, message, key) for role in ROLES)
    assert access.lets("viewer", "put", full_key(one, "stop"))


# rules that depend on the configuration


@pytest.mark.slow
@given(st.lists(IDS, min_size=1, max_size=5, unique=True))
def test_only_configured_sources_may_send_commands(names: list[str]) -> None:
    sources = tuple(Source(name, priority=1, timeout=0.25) for name in names)
    access = Access(gateway_access, commands=CommandsConfig(sources=sources), ros=RosConfig())
    for kind in ("cmd", "wheel_cmd"):
        for name in names:
            assert access.lets("operator", "put", access.key(f"{kind}/{name}/operator"))
            assert not access.lets("viewer", "put", access.key(f"{kind}/{name}/operator"))
        for name in {"teleop", "app", "dock", "nav", "ros2_control"}.difference(names):
            assert not access.lets("operator", "put", access.key(f"{kind}/{name}/operator"))
    for endpoint in endpoints(RosConfig(), ZID):
        if endpoint.native.startswith(("cmd/", "wheel_cmd/")):
            listed = endpoint.native.partition("/")[2] in names
            assert access.lets("operator", "put", endpoint.key) == listed


def test_without_sources_no_certificate_commands_but_every_client_may_stop() -> None:
    for rules in (access_control, gateway_access):
        access = Access(rules, commands=CommandsConfig(sources=()))
        assert not access.lets("maintainer", "put", access.key("cmd/app/maintainer"))
        assert access.lets("viewer", "put", access.key("stop"))
        zenoh.Config().insert_json5("access_control", json.dumps(access.value))


@each("namespace", ["", "robot1"])
@each("transport", ["bridge", "rmw"])
def test_every_ros_name_is_for_its_least_role_and_the_roles_above(
    transport: str, namespace: str
) -> None:
    other = "rmw" if transport == "bridge" else "bridge"
    ros = RosConfig(**{other: False}, namespace=namespace)
    access = Access(ros=ros, mcu=REAL, odometry=GYRO)
    endpoint_list = endpoints(ros, ZID)
    assert {endpoint.direction for endpoint in endpoint_list} == {"in", "out", "query", "service"}
    for endpoint in endpoint_list:
        key, native = endpoint.key, endpoint.native
        if endpoint.direction == "out":
            assert access.who("declare_subscriber", key) == FROM["viewer"]
            assert access.lets("viewer", "put", key, "egress")
            assert not any(access.lets(role, "put", key) for role in ROLES)
        elif endpoint.direction == "in":
            assert access.who("put", key) == FROM[LEAST.get(native, "operator")]
        else:
            least = "maintainer" if native.startswith(PARAMETERS_PREFIX) else LEAST[native]
            assert access.who("query", key) == FROM[least]
            assert access.lets("viewer", "declare_queryable", key, "egress")
        if endpoint.token:
            assert access.lets("viewer", "liveliness_token", endpoint.token, "egress")


@pytest.mark.parametrize("transport", ["bridge", "rmw"])
def test_a_ros_transport_that_is_off_has_no_keys(transport: str) -> None:
    access = Access(ros=RosConfig(**{transport: False}))  # type: ignore[arg-type]
    keys = {e.key for e in endpoints(RosConfig(), ZID) if e.transport == transport}
    named = {key for rule in access.rules.values() for key in rule["key_exprs"]}
    assert keys
    assert not keys & named
    for key in keys:
        assert not any(
            access.lets(role, message, key) for role in ROLES for message in ("put", "query")
        )


def test_the_lists_of_certificates_are_the_subjects() -> None:
    names = AccessConfig(viewers=("wall",), operators=("anna", "ben"), maintainers=("chief",))
    subjects = Access(access=names).subjects
    certificates = {role: subjects[role]["cert_common_names"] for role in ROLES}
    assert certificates == {
        "viewer": ["wall"],
        "operator": ["anna", "ben"],
        "maintainer": ["chief"],
    }


@pytest.mark.parametrize("role", ROLES)
def test_an_empty_list_of_certificates_gives_no_subject(role: Role) -> None:
    """Zenoh would apply a subject without names to every client."""
    access = Access(access=AccessConfig(**{f"{role}s": ()}))  # type: ignore[arg-type]
    assert role not in access.subjects
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
    config = zenoh.Config()
    config.insert_json5("access_control", json.dumps(access.value))
    assert json.loads(config.get_json("access_control"))["default_permission"] == "deny"
    for rule in access.value["rules"]:
        assert rule["key_exprs"]
        assert len(set(rule["key_exprs"])) == len(rule["key_exprs"])


def test_the_gateway_grants_each_role_its_permissions_and_the_daemon_everything() -> None:
    gateway = GATEWAY
    for role in ROLES:
        there, here = (
            [rule for rule in access.rules_of(role) if "/cmd/" not in rule["key_exprs"][0]]
            for access in (gateway, DEFAULT)
        )
        assert there == here
    for flow in ("ingress", "egress"):
        for message in ("put", "delete", "query", "reply", "declare_subscriber"):
            for key in ("acsard/acsar/odom", "acsard/acsar/tf_static/@adv/x", "@ros2_lv/0/x", "**"):
                assert gateway.lets("local", message, key, flow)


@each("role", ROLES)
def test_the_page_about_access_names_the_services_of_a_role(role: Role) -> None:
    text = (Path(__file__).parents[3] / "deploy" / "systemd" / "README.md").read_text()
    (row,) = re.findall(rf"^\| {role} \| .*$", text, re.M)
    named = {verb for verb in SERVICES if re.search(rf"[`*]{verb}[`*]", row)}
    assert named == {verb for verb, least in SERVICE_ROLES.items() if least == role}
