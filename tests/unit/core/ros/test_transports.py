"""Each ROS name of the robot stands for a native key, for both ROS transports."""

from __future__ import annotations

import pytest

from acsard.core.config.settings import (
    CommandsConfig,
    Config,
    LidarConfig,
    McuConfig,
    OdometryConfig,
    RosConfig,
)
from acsard.core.messages.keys_and_roles import TOPICS
from acsard.core.ros.names import TYPE_HASHES
from acsard.core.ros.transports import (
    PARAMETERS_PREFIX,
    Endpoint,
    claims,
    command_keys,
    endpoints,
    left_out,
    node_tokens,
    ros_names,
)
from tests.promised import PROMISED

ZID = "abc"
REAL = McuConfig(port="/dev/ttyACM0")


def all_endpoints(ros: RosConfig) -> list[Endpoint]:
    return list(endpoints(ros, ZID))


def keys(ros: RosConfig, transport: str) -> dict[str, str]:
    """Return the native key of each ROS name. The two types of twist count as one."""
    return {e.native: e.key for e in all_endpoints(ros) if e.transport == transport}


def test_both_trees_have_the_same_names() -> None:
    assert set(keys(RosConfig(), "bridge")) == set(keys(RosConfig(), "rmw"))


def test_the_keys_of_the_bridge_are_the_bare_names() -> None:
    assert keys(RosConfig(), "bridge") == {
        **{row.key: row.ros for row in PROMISED if row.ros},
        "cmd/nav": "cmd_vel",
        "cmd/dock": "cmd_vel_dock",
        "cmd/teleop": "cmd_vel_teleop",
        "wheel_cmd/ros2_control": "joint_commands",
        "parameters/describe_parameters": "acsard/describe_parameters",
        "parameters/get_parameter_types": "acsard/get_parameter_types",
        "parameters/get_parameters": "acsard/get_parameters",
        "parameters/list_parameters": "acsard/list_parameters",
        "parameters/set_parameters": "acsard/set_parameters",
        "parameters/set_parameters_atomically": "acsard/set_parameters_atomically",
    }


def test_every_key_has_the_namespace_and_every_service_the_node_name() -> None:
    ros = RosConfig(namespace="lab/robot1")
    bridge = keys(ros, "bridge")
    assert all(key.startswith("lab/robot1/") for key in bridge.values())
    assert bridge["tf"] == "lab/robot1/tf"
    assert bridge["srv/stop"] == "lab/robot1/acsard/stop"
    assert keys(ros, "rmw")["tf"].startswith("0/lab/robot1/tf/tf2_msgs::msg::dds_::TFMessage_/")


def test_over_rmw_a_topic_with_two_types_has_a_key_for_each_type() -> None:
    twists = [
        e.key for e in all_endpoints(RosConfig()) if e.transport == "rmw" and e.native == "cmd/nav"
    ]
    assert [key.split("/")[2] for key in twists] == [
        "geometry_msgs::msg::dds_::Twist_",
        "geometry_msgs::msg::dds_::TwistStamped_",
    ]


@pytest.mark.parametrize(("bridge", "rmw"), [(True, False), (False, True), (False, False)])
def test_each_tree_can_be_switched_off(bridge: bool, rmw: bool) -> None:
    ros = RosConfig(bridge=bridge, rmw=rmw)
    transports = {e.transport for e in all_endpoints(ros)}
    assert transports == {name for name, on in (("bridge", bridge), ("rmw", rmw)) if on}
    tokens = node_tokens(ros, ZID)
    assert any(token.startswith("@ros2_lv/") for token in tokens) == rmw
    assert any(token == "@/abc/@ros2_lv" for token in tokens) == bridge


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


def test_every_ros_name_belongs_to_a_row_of_the_topic_table() -> None:
    patterns = {topic.key.replace("<source>", ""): topic for topic in TOPICS}
    sources = {source.name for source in CommandsConfig().sources}
    for row in ros_names():
        if row.native.startswith(PARAMETERS_PREFIX):
            continue
        if row.direction == "in" and row.native not in ("imu", "speed_limit"):
            head, _, source = row.native.partition("/")
            assert source in sources
            assert patterns[f"{head}/"].direction == "in"
        else:
            assert patterns[row.native].direction == row.direction
            assert patterns[row.native].latched == row.qos.transient
        assert row.type in TYPE_HASHES


def test_only_the_latched_topics_of_the_native_tree_are_latched() -> None:
    assert {e.native for e in all_endpoints(RosConfig()) if e.latched} == {
        "tf_static",
    }


def test_every_rmw_endpoint_has_its_own_token() -> None:
    tokens = [e.token for e in all_endpoints(RosConfig()) if e.transport == "rmw"]
    assert len(set(tokens)) == len(tokens)
    numbers = [int(token.split("/")[4]) for token in tokens]
    assert numbers == list(range(1, len(tokens) + 1))
    kinds = {"out": "MP", "in": "MS", "query": "SS", "service": "SS"}
    for endpoint in all_endpoints(RosConfig()):
        if endpoint.transport == "rmw":
            assert endpoint.token.split("/")[5] == kinds[endpoint.direction]


def test_every_bridge_endpoint_with_a_single_type_is_announced() -> None:
    silent = {
        e.native for e in all_endpoints(RosConfig()) if e.transport == "bridge" and not e.token
    }
    assert silent == {"cmd/nav", "cmd/dock", "cmd/teleop"}


def test_the_command_keys_are_the_incoming_keys_of_both_trees() -> None:
    rate_limited = command_keys(RosConfig())
    assert set(rate_limited) == {e.key for e in all_endpoints(RosConfig()) if e.direction == "in"}
    assert len(rate_limited) == 6 + 9


def test_transforms_that_are_switched_off_have_no_endpoint() -> None:
    odometry = OdometryConfig(publish_tf=False, gyro=True)
    off = Config(mcu=REAL, odometry=odometry, lidar=LidarConfig(publish_tf=False))
    assert left_out(off) == {"tf", "tf_static"}
    endpoint_list = endpoints(RosConfig(), ZID, left_out(off))
    assert not {e.native for e in endpoint_list} & {"tf", "tf_static"}
    assert {e.native for e in endpoints(RosConfig(), ZID)} - {e.native for e in endpoint_list} == {
        "tf",
        "tf_static",
    }


def test_a_gyro_from_ros_is_used_if_configured_on_a_robot_that_is_not_simulated() -> None:
    wanted = OdometryConfig(gyro=True)
    assert left_out(Config(mcu=REAL, odometry=wanted)) == set()
    for other in (
        Config(mcu=REAL),
        Config(odometry=wanted),
    ):
        assert left_out(other) == {"imu"}
        assert not [e for e in endpoints(RosConfig(), ZID, left_out(other)) if e.native == "imu"]


def test_the_gyro_subscription_is_best_effort_like_sensor_publishers() -> None:
    bridge, rmw = (
        next(
            e for e in all_endpoints(RosConfig()) if e.native == "imu" and e.transport == transport
        )
        for transport in ("bridge", "rmw")
    )
    assert "/MS/imu§data/sensor_msgs§msg§Imu/:0:0:0,10:" in bridge.token
    assert rmw.token.endswith("/2::,10:,:,:,,")
    assert rmw.key.startswith("0/imu/data/sensor_msgs::msg::dds_::Imu_/RIHS01_7d9a00ff")
