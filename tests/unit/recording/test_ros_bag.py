"""The metadata file next to a bag is YAML with the intended values."""

from __future__ import annotations

import io
from typing import Any

import pytest
from ruamel.yaml import YAML

from acsard.core.ros.names import Qos
from acsard.recording.ros_bag import Topic, metadata, offered


def loaded(text: str) -> Any:
    return YAML(typ="safe").load(io.StringIO(text))


@pytest.mark.parametrize(
    ("qos", "depth", "reliability", "durability"),
    [
        (Qos(), 10, 1, 2),
        (Qos(1, transient=True), 1, 1, 1),
        (Qos(5, best_effort=True), 5, 2, 2),
    ],
)
def test_qos_policies_are_written_as_the_numbers_of_rmw(
    qos: Qos, depth: int, reliability: int, durability: int
) -> None:
    (said,) = loaded(offered(qos))
    assert (said["history"], said["depth"]) == (1, depth)
    assert (said["reliability"], said["durability"]) == (reliability, durability)
    assert said["avoid_ros_namespace_conventions"] is False


def test_topics_are_written_whatever_their_names() -> None:
    topics = [
        Topic("/odom", "nav_msgs/msg/Odometry", Qos(), 7),
        Topic("/cmd_vel_in/off", "geometry_msgs/msg/TwistStamped", Qos(), 2),
    ]
    said = loaded(metadata("yes: no #.mcap", topics, 5, 25))["rosbag2_bagfile_information"]
    assert said["relative_file_paths"] == ["yes: no #.mcap"]
    assert said["message_count"] == 9
    assert said["starting_time"] == {"nanoseconds_since_epoch": 5}
    assert said["duration"] == {"nanoseconds": 20}
    assert said["files"][0] == {
        "path": "yes: no #.mcap",
        "starting_time": {"nanoseconds_since_epoch": 5},
        "duration": {"nanoseconds": 20},
        "message_count": 9,
    }
    names = [one["topic_metadata"]["name"] for one in said["topics_with_message_count"]]
    assert names == ["/odom", "/cmd_vel_in/off"]
    first = said["topics_with_message_count"][0]
    assert loaded(first["topic_metadata"]["offered_qos_profiles"]) == loaded(offered(Qos()))
