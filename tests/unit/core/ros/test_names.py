"""Tests of the ROS 2 names, type hashes and tokens, and of the definitions behind the hashes."""

from __future__ import annotations

import hashlib
import json
import re
from typing import Any

import pytest

from acsard.core.ros.channels import ACSARD_PREFIX, DEFINITIONS
from acsard.core.ros.names import (
    TYPE_HASHES,
    Node,
    Qos,
    bridge_key,
    bridge_presence,
    bridge_token,
    dds_type,
    full_name,
    gid,
    rmw_key,
    rmw_qos,
)
from tests.each import each
from tests.vectors import ros_types

ODOMETRY = "nav_msgs/msg/Odometry"
TRIGGER = "std_srvs/srv/Trigger"


# names


@each(
    ("namespace", "name", "full"),
    [
        ("", "odom", "/odom"),
        ("robot1", "cmd_vel", "/robot1/cmd_vel"),
        ("fleet/robot1", "cmd_vel", "/fleet/robot1/cmd_vel"),
        ("", "acsard/stop", "/acsard/stop"),
    ],
)
def test_a_namespace_is_the_front_of_the_full_name(namespace: str, name: str, full: str) -> None:
    assert full_name(namespace, name) == full


@each(
    ("name", "key"),
    [
        ("/odom", "odom"),
        ("/a/b", "a/b"),
        ("/bot1/a/b", "bot1/a/b"),
        ("/tf_static", "tf_static"),
        ("/acsard/stop", "acsard/stop"),
    ],
)
def test_the_bridge_key_is_the_full_name_without_its_slash(name: str, key: str) -> None:
    assert bridge_key(name) == key


@pytest.mark.parametrize(
    ("type_name", "dds"),
    [
        (ODOMETRY, "nav_msgs::msg::dds_::Odometry_"),
        ("geometry_msgs/msg/Twist", "geometry_msgs::msg::dds_::Twist_"),
        (TRIGGER, "std_srvs::srv::dds_::Trigger_"),
    ],
)
def test_a_type_name_is_converted_to_the_form_of_dds(type_name: str, dds: str) -> None:
    assert dds_type(type_name) == dds


@each(
    ("domain", "name", "type_name", "key"),
    [
        (0, "/odom", ODOMETRY,
         "0/odom/nav_msgs::msg::dds_::Odometry_/"
         "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"),
        (0, "/robot1/cmd_vel", "geometry_msgs/msg/Twist",
         "0/robot1/cmd_vel/geometry_msgs::msg::dds_::Twist_/"
         "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"),
        (0, "/acsard/stop", TRIGGER,
         "0/acsard/stop/std_srvs::srv::dds_::Trigger_/"
         "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"),
        (42, "/tf", "tf2_msgs/msg/TFMessage",
         "42/tf/tf2_msgs::msg::dds_::TFMessage_/"
         "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"),
    ],
)  # fmt: skip
def test_the_rmw_key_has_domain_name_type_and_hash(
    domain: int, name: str, type_name: str, key: str
) -> None:
    assert rmw_key(domain, name, type_name) == key


def test_a_type_without_a_hash_has_no_rmw_key() -> None:
    with pytest.raises(KeyError):
        rmw_key(0, "/scan", "sensor_msgs/msg/LaserScan")


# RIHS01 hashes: the sha256 of the type's description as JSON, with all types it refers to

Field = tuple[str, str]

NESTED = 1
BASE = {
    "int8": 2, "uint8": 3, "int16": 4, "uint16": 5, "int32": 6, "uint32": 7, "int64": 8,
    "uint64": 9, "float32": 10, "float64": 11, "bool": 15, "byte": 16, "string": 17,
    "char": 3,  # the `char` of a message definition is a uint8
}  # fmt: skip
ARRAY, BOUNDED, SEQUENCE = 48, 96, 144
"""Offsets added to a type id."""

NO_MEMBERS = [("uint8", "structure_needs_at_least_one_member")]
"""Field that ROS adds to a struct without fields."""


def split(text: str) -> list[Field]:
    fields = [tuple(field.split()) for field in text.split(",") if field.strip()]
    return [(kind, name) for kind, name in fields] or NO_MEMBERS


def definitions() -> dict[str, list[Field]]:
    """Return the fields of every type by name; the fields of a service are its three messages."""
    known = {
        name: [*fields]
        for name, fields in DEFINITIONS.items()
        if not name.startswith(ACSARD_PREFIX)
    }
    for line in ros_types.MESSAGES.strip().splitlines():
        name, _, fields = line.partition(":")
        known[name] = split(fields)
    for line in ros_types.SERVICES.strip().splitlines():
        name, _, both = line.partition(":")
        request, _, response = both.partition("|")
        known[f"{name}_Request"] = split(request)
        known[f"{name}_Response"] = split(response)
        known[f"{name}_Event"] = [
            ("service_msgs/msg/ServiceEventInfo", "info"),
            (f"{name}_Request[<=1]", "request"),
            (f"{name}_Response[<=1]", "response"),
        ]
        known[name] = [
            (f"{name}_Request", "request_message"),
            (f"{name}_Response", "response_message"),
            (f"{name}_Event", "event_message"),
        ]
    return known


KNOWN = definitions()


def parse(kind: str) -> tuple[str, int, int]:
    """Return the base of a field's type, the offset added to its id, and its capacity."""
    match = re.fullmatch(r"([\w/]+)(?:\[(<=)?(\d*)\])?", kind)
    assert match is not None, kind
    base, bounded, size = match.groups()
    if size is None:
        return base, 0, 0
    if not size:
        return base, SEQUENCE, 0
    return base, BOUNDED if bounded else ARRAY, int(size)


def describe(name: str) -> dict[str, Any]:
    fields = []
    for kind, field in KNOWN[name]:
        base, more, capacity = parse(kind)
        nested = base not in BASE
        described = {
            "type_id": (NESTED if nested else BASE[base]) + more,
            "capacity": capacity,
            "string_capacity": 0,
            "nested_type_name": base if nested else "",
        }
        fields.append({"name": field, "type": described})
    return {"type_name": name, "fields": fields}


def referred(name: str) -> set[str]:
    """Return all types that a type contains, at any depth."""
    type_names: set[str] = set()
    for kind, _ in KNOWN[name]:
        base = parse(kind)[0]
        if base not in BASE:
            type_names |= {base} | referred(base)
    return type_names


def rihs01(name: str) -> str:
    text = json.dumps(
        {
            "type_description": describe(name),
            "referenced_type_descriptions": [describe(other) for other in sorted(referred(name))],
        }
    )
    return "RIHS01_" + hashlib.sha256(text.encode()).hexdigest()


@each("type_name", TYPE_HASHES)
def test_each_stored_type_hash_is_that_of_its_definition(type_name: str) -> None:
    assert rihs01(type_name) == TYPE_HASHES[type_name]


@pytest.mark.parametrize(
    ("type_name", "published"),
    [
        ("builtin_interfaces/msg/Time",
         "RIHS01_b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197"),
        ("geometry_msgs/msg/TransformStamped",
         "RIHS01_0a241f87d04668d94099cbb5ba11691d5ad32c2f29682e4eb5653424bd275206"),
    ],
)  # fmt: skip
def test_the_hash_function_of_this_test_matches_the_published_hashes_of_ros(
    type_name: str, published: str
) -> None:
    """The expected hashes come from ROS and not from this project.

    The hash function of the test therefore cannot share an error with acsard.
    """
    assert rihs01(type_name) == published


def test_only_the_definitions_that_the_hashes_need_are_kept() -> None:
    needed = set(TYPE_HASHES).union(*map(referred, TYPE_HASHES))
    assert set(KNOWN) == needed


ODOMETRY_HASH = "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"
TRIGGER_HASH = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
TF_HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"


def test_the_gid_is_that_of_the_captured_token() -> None:
    token = (
        "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/"
        "std_msgs::msg::dds_::String_/"
        "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,7:,:,:,,"
    )
    assert gid(token).hex() == "ac170f31eadcd9ff0cd86d7a17907d1c"


def test_different_tokens_have_different_gids() -> None:
    assert gid("a") != gid("b")
    assert len(gid("")) == 16


@each(
    ("qos", "text"),
    [
        (Qos(10), "::,10:,:,:,,"),
        (Qos(100), "::,100:,:,:,,"),
        (Qos(7), "::,7:,:,:,,"),
        (Qos(42), "::,:,:,:,,"),
        (Qos(1, transient=True), ":1:,1:,:,:,,"),
        (Qos(42, transient=True), ":1:,:,:,:,,"),
        (Qos(5, best_effort=True), "2::,5:,:,:,,"),
    ],
)
def test_the_text_of_a_qos_omits_default_values(qos: Qos, text: str) -> None:
    assert rmw_qos(qos) == text


@pytest.mark.parametrize(
    ("namespace", "token"),
    [
        ("", "@ros2_lv/0/abc/0/0/NN/%/%/acsard"),
        ("robot1", "@ros2_lv/0/abc/0/0/NN/%/%robot1/acsard"),
        ("lab/robot1", "@ros2_lv/0/abc/0/0/NN/%/%lab%robot1/acsard"),
    ],
)
def test_the_token_of_a_node_has_its_namespace(namespace: str, token: str) -> None:
    assert Node(0, "abc", namespace, "acsard").token == token


def test_the_token_of_a_publisher_has_13_parts() -> None:
    token = Node(7, "abc", "robot1", "base").endpoint_token(
        3, "MP", "/robot1/odom", ODOMETRY, Qos(10)
    )
    assert token == (
        "@ros2_lv/7/abc/0/3/MP/%/%robot1/base/%robot1%odom/"
        f"nav_msgs::msg::dds_::Odometry_/{ODOMETRY_HASH}/::,10:,:,:,,"
    )
    assert len(token.split("/")) == 13


def test_the_token_of_a_service_has_the_type_without_a_request_or_response_suffix() -> None:
    token = Node(0, "abc", "", "acsard").endpoint_token(
        9, "SS", "/acsard/stop", "std_srvs/srv/Trigger", Qos()
    )
    assert token == (
        "@ros2_lv/0/abc/0/9/SS/%/%/acsard/%acsard%stop/"
        f"std_srvs::srv::dds_::Trigger_/{TRIGGER_HASH}/::,10:,:,:,,"
    )


def test_a_bridge_announces_itself_and_its_topics_and_services() -> None:
    assert bridge_presence("abc") == "@/abc/@ros2_lv"
    assert bridge_token("abc", "MP", "/odom", ODOMETRY, Qos(10)) == (
        f"@/abc/@ros2_lv/MP/odom/nav_msgs§msg§Odometry/:1:0:0,10:typehash={ODOMETRY_HASH};"
    )
    assert bridge_token("abc", "MP", "/r/tf_static", "tf2_msgs/msg/TFMessage", Qos(1, True)) == (
        f"@/abc/@ros2_lv/MP/r§tf_static/tf2_msgs§msg§TFMessage/:1:1:0,1:typehash={TF_HASH};"
    )
    assert bridge_token("abc", "SS", "/acsard/stop", "std_srvs/srv/Trigger", Qos()) == (
        "@/abc/@ros2_lv/SS/acsard§stop/std_srvs§srv§Trigger"
    )
