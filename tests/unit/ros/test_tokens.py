"""Readers compare tokens whole, so each is written out here as ROS2.md gives it."""

from __future__ import annotations

import pytest

from acsard.ros.tokens import (
    Node,
    Qos,
    bridge_presence,
    bridge_token,
    gid,
    rmw_qos,
)

ODOMETRY = "nav_msgs/msg/Odometry"
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


def test_the_gid_of_another_token_is_another() -> None:
    assert gid("a") != gid("b")
    assert len(gid("")) == 16


@pytest.mark.parametrize(
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
def test_qos_leaves_out_what_is_the_default(qos: Qos, text: str) -> None:
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


def test_the_token_of_a_service_has_the_type_without_request_or_response() -> None:
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
