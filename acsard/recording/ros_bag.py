"""Writes the `metadata.yaml` that makes a ROS bag of a directory with an MCAP file.

The metadata has format version 5 with numeric QoS policies, which every ROS 2 release since Humble
reads. The MCAP file holds the same QoS text in the metadata of each channel, because `ros2 bag play
FILE` reads it there.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
from msgspec import Struct

from acsard.core.ros.names import Qos

METADATA = "metadata.yaml"
"""Name of the file that describes a ROS bag."""

VERSION = 5

_RELIABLE, _BEST_EFFORT = 1, 2
_TRANSIENT_LOCAL, _VOLATILE = 1, 2

_ENDLESS = "{sec: 9223372036, nsec: 854775807}"


class Topic(Struct, frozen=True):
    """A topic of the bag."""

    name: str
    type: str
    qos: Qos
    count: int
    """Number of messages."""


def offered(qos: Qos) -> str:
    """Return the QoS profile as a YAML list with one entry."""
    return "\n".join(
        [
            "- history: 1",
            f"  depth: {qos.depth}",
            f"  reliability: {_BEST_EFFORT if qos.best_effort else _RELIABLE}",
            f"  durability: {_TRANSIENT_LOCAL if qos.transient else _VOLATILE}",
            f"  deadline: {_ENDLESS}",
            f"  lifespan: {_ENDLESS}",
            "  liveliness: 1",
            f"  liveliness_lease_duration: {_ENDLESS}",
            "  avoid_ros_namespace_conventions: false",
            "",
        ]
    )


def metadata(file: str, topics: Sequence[Topic], first_ns: int, last_ns: int) -> str:
    """Return the `metadata.yaml` of a bag with one MCAP file.

    Args:
        file: name of the MCAP file.
        topics: the topics in the file.
        first_ns: wall-clock time of the earliest message, ns since 1970.
        last_ns: wall-clock time of the latest message, ns since 1970.
    """
    count = sum(topic.count for topic in topics)
    begins = f"nanoseconds_since_epoch: {first_ns}"
    lasts = f"nanoseconds: {last_ns - first_ns}"
    lines = [
        "rosbag2_bagfile_information:",
        f"  version: {VERSION}",
        "  storage_identifier: mcap",
        f"  duration: {{{lasts}}}",
        f"  starting_time: {{{begins}}}",
        f"  message_count: {count}",
        "  topics_with_message_count:",
    ]
    for topic in topics:
        lines += [
            "    - topic_metadata:",
            f"        name: {_quoted(topic.name)}",
            f"        type: {_quoted(topic.type)}",
            "        serialization_format: cdr",
            f"        offered_qos_profiles: {_quoted(offered(topic.qos))}",
            f"      message_count: {topic.count}",
        ]
    lines += [
        '  compression_format: ""',
        '  compression_mode: ""',
        f"  relative_file_paths: [{_quoted(file)}]",
        "  files:",
        f"    - path: {_quoted(file)}",
        f"      starting_time: {{{begins}}}",
        f"      duration: {{{lasts}}}",
        f"      message_count: {count}",
    ]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    """Quote a YAML string, because a name or a path may contain YAML syntax."""
    return msgspec.json.encode(text).decode()
