"""The text of a definition is complete.

It tells another program the type that the hash promises.
"""

from __future__ import annotations

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from acsard.ros.definitions import DEFINITIONS, OURS, RULE, nested, schema_text
from acsard.ros.names import TYPE_HASHES
from tests.unit.ros.test_names import rihs01

THEIRS = [name for name in DEFINITIONS if not name.startswith(OURS)]


@pytest.mark.parametrize("name", DEFINITIONS)
def test_the_text_alone_is_enough_for_another_program(name: str) -> None:
    assert {name, *nested(name)} == set(get_types_from_msg(schema_text(name), name))


@pytest.mark.parametrize("name", THEIRS)
def test_another_program_makes_the_same_hash_of_the_text(name: str) -> None:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema_text(name), name))
    known = TYPE_HASHES.get(name, rihs01(name))
    assert store.hash_rihs01(name) == known == get_typestore(Stores.ROS2_JAZZY).hash_rihs01(name)


def test_a_text_has_each_type_once_after_the_type_itself() -> None:
    text = schema_text("nav_msgs/msg/Odometry")
    first, *others = text.split(f"{RULE}\nMSG: ")
    assert first == (
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n"
    )
    assert [other.partition("\n")[0] for other in others] == [
        "std_msgs/Header", "builtin_interfaces/Time",
        "geometry_msgs/PoseWithCovariance", "geometry_msgs/Pose", "geometry_msgs/Point",
        "geometry_msgs/Quaternion",
        "geometry_msgs/TwistWithCovariance", "geometry_msgs/Twist", "geometry_msgs/Vector3",
    ]  # fmt: skip
