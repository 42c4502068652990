"""Tests of the robots that `--id` selects, and of the robot that a key belongs to."""

from __future__ import annotations

import pytest

from acsard.daemon.bus.robot_discovery import named, nobody, robot_of
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
    assert named(text) == ids


@each("text", ["a,", ",", "a,*", "a,b/c", "a,$*"])
def test_a_list_of_invalid_ids_is_refused_with_the_correct_form(text: str) -> None:
    with pytest.raises(UsageError, match="comma"):
        named(text)


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
    assert "name the robots" in nobody("tls/router.local:7447")
    assert "name the robots" not in nobody("tcp/127.0.0.1:7448")


def test_over_tls_the_message_names_the_command_that_shows_the_role() -> None:
    assert "`acsard whoami --id robot1` shows" in nobody("tls/router.local:7447")
    assert "whoami" not in nobody("tcp/127.0.0.1:7448")
