"""Tests of the robots that `--id` selects, and of the reasons why a robot is silent."""

from __future__ import annotations

import pytest

from acsard.bus.robot_discovery import (
    MAX_NAMED,
    Presence,
    explain_silence,
    no_robot_text,
    parse_ids,
    robot_of,
)
from acsard.core.messages.keys_and_roles import PUBLISHED
from acsard.host.errors import UsageError
from tests.each import each


@each(
    ("text", "ids"),
    [
        ("robot1", ()),
        ("*", ("*",)),
        ("robot1,robot2", ("robot1", "robot2")),
        ("b, a,b", ("b", "a")),
    ],
)
def test_an_id_names_one_robot_several_or_all(text: str, ids: tuple[str, ...]) -> None:
    assert parse_ids(text) == ids


@each("text", ["a,", ",", "a,*", "a,b/c", "a,$*"])
def test_a_list_of_invalid_ids_is_refused_with_the_correct_form(text: str) -> None:
    with pytest.raises(UsageError, match="comma"):
        parse_ids(text)


@each(
    ("key", "robot"),
    [
        ("acsard/robot1/state", "robot1"),
        ("acsard/robot1/srv/stop", "robot1"),
        ("acsard/*/state", ""),
        ("acsard/**", ""),
        ("acsard/robot1/**", ""),
        ("other/robot1/state", ""),
    ],
)
def test_a_key_belongs_to_one_robot_and_a_wildcard_to_none(key: str, robot: str) -> None:
    assert robot_of(key) == robot


def test_over_tls_the_message_asks_for_the_names_of_the_robots() -> None:
    assert "name the robots" in no_robot_text("tls/router.local:7447")
    assert "name the robots" not in no_robot_text("tcp/127.0.0.1:7448")


def test_over_tls_the_message_names_the_command_that_shows_the_role() -> None:
    assert "`acsard doctor --id robot1` checks" in no_robot_text("tls/router.local:7447")
    assert "doctor" not in no_robot_text("tcp/127.0.0.1:7448")


HERE, PLAIN, TLS = Presence(linked=True, here=True), "tcp/127.0.0.1:7448", "tls/router:7447"


def absent(*others: str) -> Presence:
    return Presence(True, False, others)


def test_for_an_absent_robot_the_most_similar_id_comes_first() -> None:
    text = explain_silence("state", "rob1t1", PLAIN, absent("acsar", "robot2", "robot1"))
    assert "there is no robot rob1t1. Robots here: robot1, robot2, acsar; use --id robot1" in text


def test_only_a_few_robots_of_a_large_fleet_are_named() -> None:
    text = explain_silence("state", "robot7", PLAIN, absent(*(f"robot{n:02}" for n in range(100))))
    # "no robot robot7", the listed robots, and "--id"
    assert text.count("robot") == 2 + MAX_NAMED + 1
    assert f"and {100 - MAX_NAMED} more (`acsard fleet` lists them)" in text


def test_if_no_robot_is_visible_the_message_names_the_endpoint() -> None:
    assert f"no robot is visible at {PLAIN}" in explain_silence("state", "acsar", PLAIN, absent())
    assert "`acsard doctor --id robot1`" in explain_silence("state", "robot1", TLS, absent())


def test_a_lost_connection_is_reported_before_all_other_reasons() -> None:
    text = explain_silence("oddom", "acsar", PLAIN, Presence(linked=False, here=False))
    assert f"the connection to {PLAIN} is lost" in text


@each(
    ("key", "words"),
    [
        ("oddom", "did you mean odom?"),
        ("cmd/app", "no program sends on the Zenoh key cmd/app now"),
        ("imu", "no program sends on the Zenoh key imu now"),
        ("sim/pose", "only the simulator publishes sim/pose"),
        ("json/sim/pose", "only the simulator"),
        ("events", "`acsard get events` prints its last value"),
        ("odom", "is published only while the microcontroller answers"),
        ("json/tf", "is published only while the microcontroller answers"),
        ("battery", "only while the board reports the battery's voltage or charge"),
        ("diagnostics", "lacks the permission to read it"),
    ],
)
def test_for_a_present_robot_the_reason_is_about_the_key(key: str, words: str) -> None:
    text = explain_silence(key, "acsar", PLAIN, HERE)
    assert text.startswith("robot acsar is there, but ")
    assert words in text


@each("key", [topic.key for topic in PUBLISHED])
def test_each_published_key_has_a_reason(key: str) -> None:
    assert "no such key" not in explain_silence(key, "acsar", PLAIN, HERE)
