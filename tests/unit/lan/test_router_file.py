"""Tests of the router's file for any number of robots and people.

Each may do in its own tree what one robot may do.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import zenoh

from acsard.bus.access import least_role
from acsard.host.errors import UsageError
from acsard.messages.json_schema import SCHEMAS
from acsard.messages.topics import PUBLISHED, TOPICS, json_key, source_keys, whoami_key
from acsard.values import ROLES, Role

TEMPLATE = (Path(__file__).resolve().parents[3] / "deploy" / "zenoh" / "router.json5").read_text()

TEN = tuple(f"robot{n}" for n in range(1, 11))


def read(text: str) -> Any:
    """Return the access rules and storages that Zenoh reads from the file."""
    config = zenoh.Config.from_json5(text)
    access = json.loads(config.get_json("access_control"))
    return access | {"storages": json.loads(config.get_json("plugins/storage_manager/storages"))}


def made(robots: Sequence[str], people: Mapping[Role, Sequence[str]] | None = None) -> Any:
    return read(router_file(TEMPLATE, robots, people or {}))


def test_for_one_robot_it_is_the_file_as_it_stands() -> None:
    assert made(["robot1"]) == read(TEMPLATE)


@pytest.mark.parametrize(
    ("rule", "role"),
    [("see-robot1", "viewer"), ("operate-robot1", "operator"), ("keep-robot1", "maintainer")],
)
def test_each_role_may_ask_for_what_the_bus_of_a_robot_lets_it(rule: str, role: Role) -> None:
    (keys,) = [one["key_exprs"] for one in read(TEMPLATE)["rules"] if one["id"] == rule]
    told = [topic.key for topic in PUBLISHED]
    asked = [topic.key for topic in TOPICS if topic.direction in ("query", "service")]
    asked = [key for key in asked if "<" not in key] + [f"schema/{name}" for name in SCHEMAS]
    may = {key for key in [*told, *map(json_key, told), *asked, "alive"] if least_role(key) == role}
    assert {key.removeprefix("acsard/robot1/") for key in keys} == may | {whoami_key(role)}


def test_each_of_ten_robots_has_what_one_has_and_nothing_of_another() -> None:
    one, ten = made(["robot1"]), made(TEN)
    for robots in (["robot1"], TEN):
        assert f"// It is for {', '.join(robots)}. For yours:\n" in router_file(
            TEMPLATE, robots, {}
        )
    own = [rule for rule in one["rules"] if "robot1" in rule["id"]]
    assert len(ten["rules"]) == len(one["rules"]) + 9 * len(own)
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
            for each in (one, ten)
        )
        named = [rule for rule in before if "robot1" in rule]
        assert sorted(after) == sorted(
            {rule.replace("robot1", robot) for rule in named for robot in TEN}
            | set(before) - set(named)
        )


def test_people_are_in_the_list_of_their_role_beside_its_own_certificate() -> None:
    who: dict[Role, list[str]] = {
        "operator": ["laptop-anna", "robot1-ben"],
        "viewer": ["wall"],
        "maintainer": ["chief"],
    }
    names = {s["id"]: s["cert_common_names"] for s in made(["a-1"], who)["subjects"]}
    assert names == {
        "viewers": ["viewer", "wall"],
        "operators": ["operator", "laptop-anna", "robot1-ben"],
        "maintainers": ["maintainer", "chief"],
        "robot-a-1": ["a-1"],
        **{f"certificate {name}": [name] for name in DRIVE},
    }


DRIVE = ("operator", "laptop-anna", "robot1-ben", "maintainer", "chief")


@pytest.mark.parametrize("robots", [["a-1"], ["operator-1", "robot1", "x"]])
def test_each_certificate_that_commands_has_keys_of_its_own_on_each_robot(
    robots: list[str],
) -> None:
    people: dict[Role, list[str]] = {
        "operator": ["laptop-anna", "robot1-ben"],
        "maintainer": ["chief"],
        "viewer": ["wall"],
    }
    access = made(robots, people)
    rules = {rule["id"]: rule for rule in access["rules"]}
    commands = [rule for rule in rules.values() if any("cmd/" in key for key in rule["key_exprs"])]
    own = {f"own-{robot}" for robot in robots}
    assert {rule["id"] for rule in commands} == {f"commands of {name}" for name in DRIVE} | own
    for name in DRIVE:
        rule = rules[f"commands of {name}"]
        assert set(rule["key_exprs"]) == {
            f"acsard/{robot}/{key}"
            for robot in robots
            for key in source_keys(("teleop", "app", "ros2_control", "nav"), name)
        }
        assert (rule["flows"], rule["messages"]) == (["ingress"], ["put"])
        (policy,) = [p for p in access["policies"] if rule["id"] in p["rules"]]
        assert policy["subjects"] == [f"certificate {name}"]


@pytest.mark.parametrize(
    ("robots", "people"),
    [
        (["robot1", "robot1"], {}),
        (["robot1"], {"viewer": ["robot1"]}),
        (["robot1"], {"viewer": ["anna"], "operator": ["anna"]}),
        (["operator"], {}),
    ],
)
def test_a_name_has_one_place(robots: list[str], people: Mapping[Role, Sequence[str]]) -> None:
    with pytest.raises(UsageError, match="there twice"):
        router_file(TEMPLATE, robots, people)


def test_no_robot_is_called_as_something_else_in_the_file_is() -> None:
    robots = ["viewers", "hear", "learn", "a", "see-a", "own-a", "robot-a"]
    access = made(robots)
    for kind in ("rules", "subjects"):
        ids = [one["id"] for one in access[kind]]
        assert len(set(ids)) == len(ids)
    assert len(access["storages"]) == 3 * len(robots)


def test_every_role_has_its_list() -> None:
    for role in ROLES:
        subject = f'{{ id: "{role}s", link_protocols: ["tls"], cert_common_names: ["{role}"] }}'
        assert subject in TEMPLATE
