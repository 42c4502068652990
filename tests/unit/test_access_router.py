"""The configuration of a fleet's router: what acsard writes, and what it refuses to open."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import zenoh

from acsard.bus.access_rules import gateway_access
from acsard.cli.router import open_router
from acsard.core.config.settings import (
    Config,
    McuConfig,
    OdometryConfig,
    RobotConfig,
    RosConfig,
)
from acsard.core.messages.keys_and_roles import JSON_TREE, TOPICS, source_keys
from acsard.core.values import ROLES, Role
from acsard.host.errors import CertificateError, ExitError, UsageError
from acsard.machine.router_file import router_file
from tests.each import each
from tests.system.typed import typed
from tests.unit.test_access_tls import BROKEN, make_certificates

TEMPLATE = (Path(__file__).resolve().parents[2] / "deploy" / "zenoh" / "router.json5").read_text()
TEN = tuple(f"robot{n}" for n in range(1, 11))
PEOPLE: dict[Role, list[str]] = {
    "operator": ["laptop-anna", "robot1-ben"], "viewer": ["wall"], "maintainer": ["chief"],
}  # fmt: skip
DRIVE = ("operator", "laptop-anna", "robot1-ben", "maintainer", "chief")


def read(text: str) -> Any:
    """Return the access rules and storages that Zenoh reads from the file."""
    config = zenoh.Config.from_json5(text)
    access = json.loads(config.get_json("access_control"))
    return access | {"storages": json.loads(config.get_json("plugins/storage_manager/storages"))}


def router_config(robots: Sequence[str], people: Mapping[Role, Sequence[str]] | None = None) -> Any:
    return read(router_file(TEMPLATE, robots, people or {}))


def granted(access: Any, subjects: set[str], message: str) -> set[str]:
    """Return the keys on which these subjects may send the message."""
    rules = {rule["id"]: rule for rule in access["rules"]}
    policies = [entry for entry in access["policies"] if subjects & set(entry["subjects"])]
    own_rules = [rules[name] for policy in policies for name in policy["rules"]]
    sent = [
        rule for rule in own_rules if message in rule["messages"] and "ingress" in rule["flows"]
    ]
    return {key for rule in sent for key in rule["key_exprs"]}


@each("role", ROLES)
@each("message", ["query", "put"])
def test_each_role_may_use_the_same_keys_as_at_a_robot_s_gateway(role: Role, message: str) -> None:
    gateway = gateway_access(
        Config(
            robot=RobotConfig(id="robot1"),
            ros=RosConfig(bridge=False, rmw=False),
            mcu=McuConfig(port="/dev/ttyACM0"),
            odometry=OdometryConfig(gyro=True),
        )
    )
    keys = granted(read(TEMPLATE), {f"{role}s", f"certificate {role}"}, message)
    # A fleet may have a simulated robot. `alive` answers nothing.
    simulated = {topic.key for topic in TOPICS if topic.simulated}
    keys -= {f"acsard/robot1/{tree}{key}" for key in simulated for tree in ("", JSON_TREE)}
    keys -= {"acsard/robot1/alive"} if message == "query" else set()
    assert keys == granted(gateway, {role, f"certificate {role}"}, message)


@each("message", ["reply", "declare_queryable", "liveliness_token"])
def test_behind_a_router_only_a_robot_answers_for_itself(
    message: str,
) -> None:
    """Otherwise a viewer could show the others a pose, a state or a version of its own."""
    access = router_config(["robot1", "robot2"])
    for role in ROLES:
        assert granted(access, {f"{role}s", f"certificate {role}"}, message) == set()
    keys = granted(access, {"robot-robot1"}, message)
    assert keys
    assert all(key.startswith("acsard/robot1/") for key in keys)


def test_each_of_ten_robots_has_its_own_keys_and_none_of_another_robot() -> None:
    single, ten = router_config(["robot1"]), router_config(TEN)
    assert single == read(TEMPLATE)
    line = f"// This file is for {', '.join(TEN)}. To make a file for your own robots:\n"
    assert line in router_file(TEMPLATE, TEN, {})
    own = [rule for rule in single["rules"] if "robot1" in rule["id"]]
    assert len(ten["rules"]) == len(single["rules"]) + 9 * len(own)
    rules = {rule["id"]: rule for rule in ten["rules"]}
    for robot in TEN:
        for rule in own:
            there = rules[rule["id"].replace("robot1", robot)]
            assert there["key_exprs"] == [
                key.replace("acsard/robot1/", f"acsard/{robot}/") for key in rule["key_exprs"]
            ]
        (policy,) = [p for p in ten["policies"] if p["subjects"] == [f"robot-{robot}"]]
        assert policy["rules"] == [f"own-{robot}"]
        (subject,) = [s for s in ten["subjects"] if s["id"] == f"robot-{robot}"]
        assert subject["cert_common_names"] == [robot]
        assert {f"{robot}-state", f"{robot}-odom", f"{robot}-tf_static"} <= ten["storages"].keys()
    for role in ("viewers", "operators", "maintainers"):
        before, after = (
            next(p["rules"] for p in each["policies"] if p["subjects"] == [role])
            for each in (single, ten)
        )
        named = [rule for rule in before if "robot1" in rule]
        assert sorted(after) == sorted(
            {rule.replace("robot1", robot) for rule in named for robot in TEN}
            | set(before) - set(named)
        )


def test_the_file_of_a_router_is_printed_for_the_typed_robots_and_people() -> None:
    ended = typed("tls", "router", "robot1", "robot2", "--operator", "laptop-anna")
    assert ended.code == 0
    expected = router_file(TEMPLATE, ["robot1", "robot2"], {"operator": ["laptop-anna"]})
    assert ended.out == expected.rstrip("\n")
    assert typed("tls", "router", "robot 1").code == 2


@pytest.mark.parametrize("robots", [["a-1"], ["operator-1", "robot1", "x"]])
def test_each_commanding_certificate_has_keys_of_its_own_on_each_robot(robots: list[str]) -> None:
    access = router_config(robots, PEOPLE)
    names = {s["id"]: s["cert_common_names"] for s in access["subjects"]}
    assert names == {
        "viewers": ["viewer", "wall"], "operators": ["operator", "laptop-anna", "robot1-ben"],
        "maintainers": ["maintainer", "chief"],
        **{f"robot-{robot}": [robot] for robot in robots},
        **{f"certificate {name}": [name] for name in DRIVE},
    }  # fmt: skip
    rules = {rule["id"]: rule for rule in access["rules"]}
    commands = [rule for rule in rules.values() if any("cmd/" in key for key in rule["key_exprs"])]
    own = {f"own-{robot}" for robot in robots}
    assert {rule["id"] for rule in commands} == {f"commands of {name}" for name in DRIVE} | own
    for name in DRIVE:
        rule = rules[f"commands of {name}"]
        assert set(rule["key_exprs"]) == {
            f"acsard/{robot}/{key}"
            for robot in robots
            for key in source_keys(("teleop", "app", "ros2_control", "dock", "nav"), name)
        }
        assert (rule["flows"], rule["messages"]) == (["ingress"], ["put"])
        (policy,) = [p for p in access["policies"] if rule["id"] in p["rules"]]
        assert policy["subjects"] == [f"certificate {name}"]


def test_a_robot_may_have_a_name_that_the_template_uses_otherwise() -> None:
    robots = ["viewers", "hear", "learn", "a", "see-a", "own-a", "robot-a"]
    access = router_config(robots)
    for kind in ("rules", "subjects"):
        ids = [entry["id"] for entry in access[kind]]
        assert len(set(ids)) == len(ids)
    assert len(access["storages"]) == 3 * len(robots)


@each(
    ("robots", "people"),
    [
        (["robot1", "robot1"], {}), (["robot1"], {"viewer": ["robot1"]}),
        (["robot1"], {"viewer": ["anna"], "operator": ["anna"]}), (["operator"], {}),
    ],
)  # fmt: skip
def test_a_name_may_occur_once(robots: list[str], people: Mapping[Role, Sequence[str]]) -> None:
    with pytest.raises(UsageError, match="occur more than once"):
        router_file(TEMPLATE, robots, people)


# files that the router does not open


@each(
    ("text", "phrase"),
    [
        ('{ mode: "peer", listen: { endpoints: ["tcp/127.0.0.1:0"] } }',
         "not the configuration of a router"),
        ('{ mode: "router", listen: { endpoints: [] } }', "not the configuration of a router"),
        ('{ mode: "router" }', "needs mode"),  # Zenoh would listen on every address, unencrypted
        ('{ mode: "ruter" }', "; correct it"), ("", "router.json5"),
        ("{ mode", "line 1, column 1: expected array, boolean, null, number, object, or string"),
        ('{\n  mode: "router"\n  listen: {} }', "line 2, column 9: expected boolean or null"),
        ('{ mode: "ruter" }', "line 1, column 9: unknown variant `ruter`, expected one of"),
        ("{\n  foo: 1 }", "line 2, column 3: unknown field `foo`"),
        ("{\n  foo: 1 }", "`plugins_loading`, `plugins`"),  # the last of 23 names
        ('{ mode: "a\\"b" }', 'unknown variant `a"b`'),
        (None, "router.json5"),
    ],
)  # fmt: skip
def test_a_file_that_is_not_for_a_router_is_refused_with_its_name_the_place_and_the_fix(
    tmp_path: Path, text: str | None, phrase: str
) -> None:
    file = tmp_path / "router.json5"
    file.unlink(missing_ok=True)
    if text is not None:
        file.write_text(text)
    with pytest.raises(ExitError) as error:
        open_router(file)
    assert phrase in str(error.value)
    assert "router.json5" in str(error.value)
    assert not [word for word in (".rs", "Location") if word in str(error.value)]


@each("how", ["no key", "another's key"])
def test_wrong_certificate_files_are_a_bad_configuration_with_their_path(
    tmp_path: Path, how: str
) -> None:
    BROKEN[how](make_certificates(tmp_path))
    file = tmp_path / "router.json5"
    text = TEMPLATE.replace("/etc/zenohd/tls", str(tmp_path)).replace("0.0.0.0:7447", "127.0.0.1:0")
    file.write_text(text)
    with pytest.raises(CertificateError, match=str(tmp_path)):
        open_router(file)
