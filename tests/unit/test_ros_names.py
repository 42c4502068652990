"""The ROS 2 names, type hashes, tokens and attachments, and the native key of each name.

Rosbags computes the hashes again, and the serializer of Zenoh the attachments.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
import zenoh.ext
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from acsard.core.config.settings import (
    Config,
    LidarConfig,
    McuConfig,
    OdometryConfig,
    RosConfig,
)
from acsard.core.messages.encodings import DecodeError
from acsard.core.ros.attachments import Attachment, unpack
from acsard.core.ros.channels import ACSARD_PREFIX, DEFINITIONS, schema_text
from acsard.core.ros.names import (
    TYPE_HASHES,
    Node,
    Qos,
    bridge_presence,
    bridge_token,
    dds_type,
    gid,
    rmw_key,
    rmw_qos,
)
from acsard.core.ros.transports import (
    Endpoint,
    claims,
    command_keys,
    endpoints,
    node_tokens,
    unused_keys,
)
from tests.each import each
from tests.promised import PROMISED
from tests.vectors import ros_types

ODOMETRY, TRIGGER = "nav_msgs/msg/Odometry", "std_srvs/srv/Trigger"
ODOMETRY_HASH = "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"
TRIGGER_HASH = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
TF_HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"


# hashes


def in_services(parsed: Any) -> Any:
    """Return a parsed definition in which the parts of a service have their right names."""
    if isinstance(parsed, tuple | list):
        return type(parsed)(map(in_services, parsed))
    return parsed.replace("/srv/msg/", "/srv/") if isinstance(parsed, str) else parsed


@cache
def store() -> Any:
    """Return a type store of rosbags with acsard's definitions, and with those of the services."""
    found: dict[str, Any] = {}
    for name in DEFINITIONS:
        if not name.startswith(ACSARD_PREFIX):
            found |= get_types_from_msg(schema_text(name), name)

    def add(name: str, fields: str) -> None:
        # The `char` of a message definition is a uint8.
        lines = "\n".join(field.strip() for field in fields.replace("char", "uint8").split(","))
        (parsed,) = get_types_from_msg(lines, "x/msg/X").values()
        found[name] = in_services(parsed)

    for line in ros_types.MESSAGES.strip().splitlines():
        name, _, fields = line.partition(":")
        add(name, fields)
    for line in ros_types.SERVICES.strip().splitlines():
        name, _, both = line.partition(":")
        request, _, response = both.partition("|")
        add(f"{name}_Request", request)
        add(f"{name}_Response", response)
        add(f"{name}_Event", f"service_msgs/msg/ServiceEventInfo info,{name}_Request[<=1] request,"
                             f"{name}_Response[<=1] response")  # fmt: skip
        add(name, f"{name}_Request request_message,{name}_Response response_message,"
                  f"{name}_Event event_message")  # fmt: skip
    new: Any = get_typestore(Stores.EMPTY)
    new.fielddefs.update(found)
    return new


@each("name", [*TYPE_HASHES, *DEFINITIONS])
def test_another_program_computes_the_same_hash_from_the_definition(name: str) -> None:
    if name.startswith(ACSARD_PREFIX):
        return
    computed, jazzy = store().hash_rihs01(name), get_typestore(Stores.ROS2_JAZZY)
    assert computed == TYPE_HASHES.get(name, computed)
    if name in jazzy.fielddefs:
        assert computed == jazzy.hash_rihs01(name)


# names


@each(
    ("domain", "name", "type_name", "dds"),
    [
        (0, "odom", ODOMETRY, "nav_msgs::msg::dds_::Odometry_"),
        (0, "robot1/cmd_vel", "geometry_msgs/msg/Twist", "geometry_msgs::msg::dds_::Twist_"),
        (42, "acsard/stop", TRIGGER, "std_srvs::srv::dds_::Trigger_"),
    ],
)  # fmt: skip
def test_the_rmw_key_has_domain_name_type_and_hash(
    domain: int, name: str, type_name: str, dds: str
) -> None:
    assert dds_type(type_name) == dds
    expected = f"{domain}/{name}/{dds}/{TYPE_HASHES[type_name]}"
    assert rmw_key(domain, f"/{name}", type_name) == expected
    with pytest.raises(KeyError):
        rmw_key(0, "/scan", "sensor_msgs/msg/LaserScan")


# tokens


def test_the_gid_is_that_of_the_captured_token() -> None:
    token = (
        "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/"
        "std_msgs::msg::dds_::String_/"
        "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,7:,:,:,,"
    )
    assert gid(token).hex() == "ac170f31eadcd9ff0cd86d7a17907d1c"
    assert (len(gid("")), gid("a") == gid("b")) == (16, False)


@each(
    ("qos", "text"),
    [
        (Qos(10), "::,10:,:,:,,"), (Qos(7), "::,7:,:,:,,"), (Qos(42), "::,:,:,:,,"),
        (Qos(1, transient=True), ":1:,1:,:,:,,"), (Qos(42, transient=True), ":1:,:,:,:,,"),
        (Qos(5, best_effort=True), "2::,5:,:,:,,"),
    ],
)  # fmt: skip
def test_the_text_of_a_qos_omits_default_values(qos: Qos, text: str) -> None:
    assert rmw_qos(qos) == text


def test_the_tokens_of_a_node_and_of_its_endpoints_over_rmw() -> None:
    assert Node(0, "abc", "", "acsard").token == "@ros2_lv/0/abc/0/0/NN/%/%/acsard"
    deep = Node(0, "abc", "lab/robot1", "acsard").token
    assert deep == "@ros2_lv/0/abc/0/0/NN/%/%lab%robot1/acsard"
    publisher = Node(7, "abc", "robot1", "base").endpoint_token(
        3, "MP", "/robot1/odom", ODOMETRY, Qos(10)
    )
    assert publisher == (
        "@ros2_lv/7/abc/0/3/MP/%/%robot1/base/%robot1%odom/"
        f"nav_msgs::msg::dds_::Odometry_/{ODOMETRY_HASH}/::,10:,:,:,,"
    )
    # That of a service has the type without a suffix for request or response.
    service = Node(0, "abc", "", "acsard").endpoint_token(9, "SS", "/acsard/stop", TRIGGER, Qos())
    assert service == (
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
    assert bridge_token("abc", "SS", "/acsard/stop", TRIGGER, Qos()) == (
        "@/abc/@ros2_lv/SS/acsard§stop/std_srvs§srv§Trigger"
    )


# attachments of rmw_zenoh

CAPTURED = bytes.fromhex("010000000000000015cd853dfe9c971710ac170f31eadcd9ff0cd86d7a17907d1c")


def test_the_captured_bytes_are_written_and_read_exactly() -> None:
    attachment = Attachment(1, 1_700_000_000_123_456_789, CAPTURED[17:])
    assert attachment.pack() == CAPTURED
    assert unpack(CAPTURED) == attachment


numbers = st.integers(-(2**63), 2**63 - 1)


@given(st.builds(Attachment, numbers, numbers, st.binary(min_size=16, max_size=16)))
def test_the_serializer_of_zenoh_writes_the_same_bytes(attachment: Attachment) -> None:
    whole = zenoh.ext.Int64(attachment.sequence), zenoh.ext.Int64(attachment.stamp_ns)
    packed = attachment.pack()
    assert packed == zenoh.ext.z_serialize((*whole, attachment.gid)).to_bytes()
    assert unpack(packed) == attachment


@each("size", [0, 1, 16, 20, 32, 34, 64])
@each("of_gid", [16, 0, 15, 17, 255])
def test_an_attachment_of_another_length_is_refused(size: int, of_gid: int) -> None:
    data = (CAPTURED[:16] + bytes([of_gid]) + CAPTURED[17:] * 3)[: size if of_gid == 16 else 33]
    with pytest.raises(DecodeError) as caught:
        unpack(data)
    assert caught.value.reason == ("bad_attachment" if data else "no_attachment")


@given(st.binary(max_size=70))
def test_any_bytes_are_an_attachment_or_refused(data: bytes) -> None:
    try:
        attachment = unpack(data)
    except DecodeError:
        return
    assert attachment.pack() == data


# the native key of each name

ZID, REAL = "abc", McuConfig(port="/dev/ttyACM0")


def all_endpoints(ros: RosConfig | None = None, transport: str = "") -> list[Endpoint]:
    found = endpoints(ros or RosConfig(), ZID)
    return [endpoint for endpoint in found if transport in ("", endpoint.transport)]


def keys(transport: str, ros: RosConfig | None = None) -> dict[str, str]:
    """Return the native key of each ROS name. The two types of twist count as one."""
    return {e.native: e.key for e in all_endpoints(ros, transport)}


def test_the_keys_of_the_bridge_are_the_bare_names_and_rmw_has_the_same_names() -> None:
    services = ("describe_parameters", "get_parameter_types", "get_parameters", "list_parameters",
                "set_parameters", "set_parameters_atomically")  # fmt: skip
    assert keys("bridge") == {
        **{row.key: row.ros for row in PROMISED if row.ros},
        "cmd/nav": "cmd_vel", "cmd/dock": "cmd_vel_dock", "cmd/teleop": "cmd_vel_teleop",
        "wheel_cmd/ros2_control": "joint_commands",
        **{f"parameters/{name}": f"acsard/{name}" for name in services},
    }  # fmt: skip
    assert set(keys("rmw")) == set(keys("bridge"))
    assert {e.native for e in all_endpoints() if e.latched} == {"tf_static"}


def test_over_rmw_a_topic_with_two_types_has_a_key_for_each_type() -> None:
    twists = [e.key.split("/")[2] for e in all_endpoints(None, "rmw") if e.native == "cmd/nav"]
    assert twists == ["geometry_msgs::msg::dds_::Twist_", "geometry_msgs::msg::dds_::TwistStamped_"]
    rate_limited = command_keys(RosConfig())
    limited = {e.key for e in all_endpoints() if e.direction == "in" and e.native != "stop"}
    assert set(rate_limited) == limited, "no rate limit may drop a stop"
    assert len(rate_limited) == 6 + 9


@pytest.mark.parametrize(("bridge", "rmw"), [(True, False), (False, True), (False, False)])
def test_each_tree_can_be_switched_off(bridge: bool, rmw: bool) -> None:
    ros = RosConfig(bridge=bridge, rmw=rmw)
    on = {name for name, is_on in (("bridge", bridge), ("rmw", rmw)) if is_on}
    assert {e.transport for e in all_endpoints(ros)} == on
    tokens = node_tokens(ros, ZID)
    assert any(token.startswith("@ros2_lv/") for token in tokens) == rmw
    assert ("@/abc/@ros2_lv" in tokens) == bridge


def test_two_robots_share_a_claim_if_one_topic_would_drive_both() -> None:
    def shared(first: RosConfig, two: RosConfig) -> bool:
        return bool({*claims(first)} & {*claims(two)})

    usual, named = RosConfig(), RosConfig(namespace="lab/robot1")
    assert shared(usual, RosConfig(domain=7))
    assert shared(named, RosConfig(namespace="lab/robot1", domain=7)), "the bridge knows no domain"
    assert not shared(usual, named)
    assert not shared(RosConfig(bridge=False), RosConfig(bridge=False, domain=7))
    assert not shared(RosConfig(bridge=False), RosConfig(rmw=False)), "no commander reaches both"
    assert claims(RosConfig(bridge=False, rmw=False)) == ()


def test_every_endpoint_with_a_single_type_has_its_own_token() -> None:
    tokens = [e.token.split("/") for e in all_endpoints(None, "rmw")]
    assert [int(parts[4]) for parts in tokens] == [*range(1, len(tokens) + 1)]
    kinds = {"out": "MP", "in": "MS", "query": "SS", "service": "SS"}
    assert [parts[5] for parts in tokens] == [
        kinds[e.direction] for e in all_endpoints(None, "rmw")
    ]
    bridge = all_endpoints(None, "bridge")
    silent = {e.native for e in bridge if not e.token}
    assert silent == {"cmd/nav", "cmd/dock", "cmd/teleop"}
    assert len({e.key for e in bridge}) == len(bridge)


def test_what_a_robot_does_not_publish_or_use_has_no_endpoint() -> None:
    gyro = OdometryConfig(gyro=True)
    assert unused_keys(Config(mcu=REAL, odometry=gyro)) == set()
    assert unused_keys(Config(mcu=REAL)) == unused_keys(Config(odometry=gyro)) == {"imu"}
    odometry = OdometryConfig(publish_tf=False, gyro=True)
    off = Config(mcu=REAL, odometry=odometry, lidar=LidarConfig(publish_tf=False))
    assert unused_keys(off) == {"tf", "tf_static"}
    present = {e.native for e in endpoints(RosConfig(), ZID, unused_keys(off))}
    assert {e.native for e in all_endpoints()} - present == {"tf", "tf_static"}


def test_the_gyro_subscription_is_best_effort_like_sensor_publishers() -> None:
    bridge, rmw = (e for e in all_endpoints() if e.native == "imu")
    assert "/MS/imu§data/sensor_msgs§msg§Imu/:0:0:0,10:" in bridge.token
    assert rmw.token.endswith("/2::,10:,:,:,,")
    assert rmw.key.startswith("0/imu/data/sensor_msgs::msg::dds_::Imu_/RIHS01_7d9a00ff")
