"""The known facts about a robot determine the topics that the bridge offers to a viewer."""

from __future__ import annotations

from msgspec.structs import replace

from acsard.core.config.settings import Config
from acsard.foxglove.robot_facts import Facts, key_of

SOURCES = ("teleop", "app")


def topics(config: Config) -> dict[str, str]:
    """Return the bus key of each topic."""
    rows = Facts(config, None, SOURCES, "").rows()
    return {row.topic(config.ros.namespace, name): key_of(row, name) for row, name in rows}


def test_each_source_has_a_topic_of_its_own() -> None:
    keys = topics(Config())
    assert keys["/cmd_vel_in/teleop"] == "cmd/teleop"
    assert keys["/cmd_vel_in/app"] == "cmd/app"
    assert keys["/joint_states"] == "wheel_states"
    assert keys["/log"] == "events"


def test_a_namespace_precedes_every_topic() -> None:
    config = replace(Config(), ros=replace(Config().ros, namespace="robot1"))
    assert all(topic.startswith("/robot1/") for topic in topics(config))


def test_topics_that_the_robot_does_not_publish_are_not_offered() -> None:
    quiet = replace(Config(), odometry=replace(Config().odometry, publish_tf=False))
    assert "/tf" in topics(Config())
    assert "/tf" not in topics(quiet)
