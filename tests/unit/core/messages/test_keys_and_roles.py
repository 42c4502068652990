"""The table of keys has every key of the design exactly once, and full keys have the right form."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, McuConfig, OdometryConfig
from acsard.core.messages.keys_and_roles import (
    PUBLISHED,
    SERVICES,
    TOPICS,
    VERBS,
    by_key,
    command_key,
    full_key,
    json_key,
    offered,
    published,
    row_of,
    source_keys,
)
from acsard.core.messages.schema import MESSAGES
from tests import promised
from tests.each import each
from tests.promised import PROMISED


def test_the_topic_table_is_that_of_the_design() -> None:
    rows = [(row.key, row.direction, row.type) for row in PROMISED]
    assert sorted((t.key, t.direction, t.type) for t in TOPICS) == sorted(rows)


def test_no_key_appears_twice() -> None:
    assert len({topic.key for topic in TOPICS}) == len(TOPICS)


def test_every_row_has_a_description() -> None:
    assert all(topic.note for topic in TOPICS)


def test_the_published_topics_are_all_outgoing_ones_except_token_and_json_copies() -> None:
    assert [topic.key for topic in PUBLISHED] == [row.key for row in promised.PUBLISHED]
    assert all(topic.type in MESSAGES for topic in PUBLISHED)


def test_only_the_static_transforms_are_latched() -> None:
    assert [topic.key for topic in TOPICS if topic.latched] == ["tf_static"]


GYRO = OdometryConfig(gyro=True)
REAL = Config(mcu=McuConfig(port="/dev/ttyACM0"))


def test_the_true_pose_is_offered_only_by_a_simulated_robot() -> None:
    simulated = {topic.key for topic in offered(Config())}
    assert simulated - {topic.key for topic in offered(REAL)} == {"sim/pose"}


@pytest.mark.parametrize("config", [Config(), REAL, replace(REAL, odometry=GYRO)])
def test_the_published_topics_are_the_offered_outgoing_topics(config: Config) -> None:
    assert published(config) == tuple(row for row in offered(config) if row in PUBLISHED)


@pytest.mark.parametrize("config", [Config(), REAL])
def test_the_imu_topic_is_offered_only_if_the_gyro_is_enabled(config: Config) -> None:
    wanted = {topic.key for topic in offered(replace(config, odometry=GYRO))}
    assert wanted - {topic.key for topic in offered(config)} == {"imu"}


def test_the_simulator_publishes_its_gyro() -> None:
    keys = {topic.key for topic in published(Config(odometry=GYRO))}
    assert keys - {topic.key for topic in PUBLISHED} == {"imu"}


@each("service", SERVICES)
def test_every_service_has_a_row(service: str) -> None:
    row = by_key(f"srv/{service}")
    assert row is not None
    assert row.direction == "service"
    assert VERBS[row.key] == service


def test_a_full_key_contains_the_robot_id() -> None:
    assert full_key("r7", "cmd/teleop") == "acsard/r7/cmd/teleop"


@each(
    ("key", "pattern"),
    [("cmd/<source>", "cmd/*"), ("wheel_cmd/<source>", "wheel_cmd/*"),
     ("cmd/<source>/<certificate>", "cmd/*/*"),
     ("schema/<Type>", "schema/*"), ("json/<key>", "json/**"),
     ("odom", "odom"), ("srv/stop", "srv/stop")],
)  # fmt: skip
def test_a_placeholder_is_a_wildcard_on_the_bus(key: str, pattern: str) -> None:
    row = by_key(key)
    assert row is not None
    assert row.pattern == pattern


def test_a_source_commands_by_twist_or_by_wheels() -> None:
    keys = ["cmd/app", "cmd/nav", "wheel_cmd/app", "wheel_cmd/nav"]
    assert source_keys(["app", "nav"]) == keys
    assert source_keys(["app"], "anna") == ["cmd/app/anna", "wheel_cmd/app/anna"]
    assert [command_key("cmd", "app"), command_key("cmd", "app", "anna")] == [
        "cmd/app",
        "cmd/app/anna",
    ]


def test_a_published_key_is_in_the_json_tree_under_its_full_name() -> None:
    assert json_key("sim/pose") == "json/sim/pose"


def test_a_key_that_is_not_in_the_table_does_not_exist() -> None:
    assert by_key("odometry") is None
    assert by_key("cmd/teleop") is None


def test_every_key_of_the_table_has_its_row_and_an_unknown_key_has_no_row() -> None:
    for topic in TOPICS:
        filled = (
            topic.key.replace("<source>", "app")
            .replace("<certificate>", "laptop anna")
            .replace("<Type>", "Twist")
            .replace("<role>", "viewer")
            .replace("<verb>", "ghost")
        )
        assert row_of(filled) is topic
        assert row_of(topic.key) is topic
    for key in ("", "cmd", "cmd/", "cmd/app/x/y", "cmd//x", "schema/", "odometry", "srv/a/b"):
        assert row_of(key) is None
