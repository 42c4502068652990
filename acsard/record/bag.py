"""What a directory says of the MCAP file in it, for `ros2 bag` and whatever else opens bags.

Format 5, with numbers for the qualities of service: every ROS 2 since Humble reads it. The same
text of the qualities stands beside each channel in the file, where `ros2 bag play FILE` finds it.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
from msgspec import Struct

from acsard.ros.tokens import Qos

VERSION = 5

_RELIABLE, _BEST_EFFORT = 1, 2
_TRANSIENT_LOCAL, _VOLATILE = 1, 2

_ENDLESS = "{sec: 9223372036, nsec: 854775807}"


class Topic(Struct, frozen=True):
    """A topic of the file."""

    name: str
    type: str
    qos: Qos
    count: int


def offered(qos: Qos) -> str:
    """The quality of service as a list of one, YAML."""
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
    """`metadata.yaml` of a directory with this one file; times are wall-clock, of its messages."""
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
    """A YAML string; a name from a configuration or a path may hold what YAML means."""
    return msgspec.json.encode(text).decode()
