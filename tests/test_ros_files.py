"""The files in deploy/ros2 describe the robot to ROS with the same numbers as acsard's defaults.

The tests do not need ROS. They do not show that ROS itself accepts the files.
"""

from __future__ import annotations

import json
import re
import runpy
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import MagicMock

import msgspec
import pytest
import zenoh
from msgspec.structs import replace
from ruamel.yaml import YAML

from acsard.core.codes import reason
from acsard.core.config.settings import DIAGNOSTICS_HZ, BusConfig, Config, RosConfig, WheelMap
from acsard.core.messages.diagnostics import diagnostics
from acsard.core.motion.neutral import NEUTRAL_PAUSE_NS
from acsard.core.ros.transports import ros_names
from acsard.core.values import NS_PER_S, Recording
from tests import promised
from tests.unit.examples import OUTPUTS, SNAPSHOT, changed

FILES = Path(__file__).parents[1] / "deploy" / "ros2"
CONFIG = Config()


def manual(page: str) -> str:
    """Return the text of a page of the manual."""
    return (FILES.parent / f"manual/pages/{page}.md").read_text()


WHEEL_SIGNS = {  # x and y of each wheel's position
    CONFIG.joints.front_right: (1, -1),
    CONFIG.joints.front_left: (1, 1),
    CONFIG.joints.rear_left: (-1, 1),
    CONFIG.joints.rear_right: (-1, -1),
    CONFIG.joints.left: (0, 1),
    CONFIG.joints.right: (0, -1),
}
TIMEOUTS = {source.timeout for source in CONFIG.commands.sources}


class Described(NamedTuple):
    """A robot, and the directory of the files that describe it."""

    config: Config
    files: Path

    def urdf(self) -> ET.Element:
        return ET.parse(self.files / "acsar.urdf").getroot()

    def joint(self, name: str) -> ET.Element:
        return find_only(self.urdf(), f"joint[@name='{name}']")

    def joint_to(self, link: str) -> ET.Element:
        joints = self.urdf().findall("joint")
        return next(j for j in joints if find_only(j, "child").get("link") == link)


@pytest.fixture(scope="module", params=["four wheels", "two wheels"])
def robot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Described:
    """Return a robot with four driven wheels, or with two after the command of the manual."""
    if request.param == "four wheels":
        return Described(CONFIG, FILES)
    wheels = WheelMap(left="+l", right="+r")
    files = tmp_path_factory.mktemp("two")
    for name in ("acsar.urdf", "controllers.yaml"):
        shutil.copy(FILES / name, files)
    (command,) = re.findall(r"^sed .+$", manual("howto/two-wheels"), re.M)
    subprocess.run(["sh", "-c", command], cwd=files, check=True, timeout=20)
    return Described(replace(CONFIG, mcu=replace(CONFIG.mcu, wheels=wheels)), files)


def find_only(element: ET.Element, path: str) -> ET.Element:
    elements = element.findall(path)
    assert len(elements) == 1, path
    return elements[0]


def numbers(text: str | None) -> list[float]:
    return [float(number) for number in (text or "").split()]


def yaml(name: str, files: Path = FILES) -> Any:
    return YAML(typ="safe").load((files / name).read_text())


def ros_parameters(name: str, node: str, files: Path = FILES) -> dict[str, Any]:
    parameters: dict[str, Any] = yaml(name, files)[node]["ros__parameters"]
    return parameters


def bridge() -> zenoh.Config:
    return zenoh.Config.from_file(str(FILES / "zenoh-bridge-ros2dds.json5"))


def bridge_setting(path: str) -> Any:
    return json.loads(bridge().get_json(path))


def published_names(direction: str) -> set[str]:
    return {f"/{row.name}" for row in ros_names() if row.direction == direction}


# acsar.urdf


def test_each_wheel_touches_the_floor_at_half_the_wheel_separation(robot: Described) -> None:
    radius, half = CONFIG.drive.wheel_radius, CONFIG.drive.wheel_separation / 2
    wheels = [j.get("name") for j in robot.urdf().findall("joint[@type='continuous']")]
    assert tuple(wheels) == robot.config.joint_names
    for name in robot.config.joint_names:
        joint = robot.joint(name)
        assert find_only(joint, "parent").get("link") == CONFIG.odometry.base_frame
        x, y, z = numbers(find_only(joint, "origin").get("xyz"))
        assert (y, z) == pytest.approx((WHEEL_SIGNS[name][1] * half, radius))
        assert (x > 0) - (x < 0) == WHEEL_SIGNS[name][0]
        assert numbers(find_only(joint, "axis").get("xyz")) == [0, 1, 0]
        limit = find_only(joint, "limit").get("velocity")
        assert numbers(limit) == [CONFIG.limits.wheel_speed]


def test_each_link_has_a_joint_to_it_and_none_is_left_over(robot: Described) -> None:
    links = {link.get("name") for link in robot.urdf().findall("link")}
    joints = robot.urdf().findall("joint")
    children = [find_only(joint, "child").get("link") for joint in joints]
    assert sorted([*map(str, children), CONFIG.odometry.base_frame]) == sorted(map(str, links))


def test_lidar_and_footprint_frames_agree_with_the_configuration(robot: Described) -> None:
    lidar = CONFIG.lidar
    for link, xyz, rpy in (
        (lidar.lidar_frame, [lidar.lidar_x_offset, lidar.lidar_y_offset, 0],
         [0, 0, lidar.lidar_yaw]),
        ("base_footprint", [0, 0, 0], [0, 0, 0]),
    ):  # fmt: skip
        fixed_joint = robot.joint_to(link)
        assert find_only(fixed_joint, "parent").get("link") == CONFIG.odometry.base_frame
        assert numbers(find_only(fixed_joint, "origin").get("xyz")) == xyz
        assert numbers(find_only(fixed_joint, "origin").get("rpy")) == rpy


def test_ros2_control_has_what_the_topic_hardware_needs(robot: Described) -> None:
    control = find_only(robot.urdf(), "ros2_control")
    assert control.get("type") == "system"
    plugin = find_only(control, "hardware/plugin").text
    assert plugin == "joint_state_topic_hardware_interface/JointStateTopicSystem"
    parameters = {p.get("name"): p.text for p in control.findall("hardware/param")}
    assert parameters["joint_commands_topic"] == "/joint_commands"
    assert parameters["joint_states_topic"] == "/joint_states"
    assert parameters["trigger_joint_command_threshold"] == "-1"
    assert tuple(j.get("name") for j in control.findall("joint")) == robot.config.joint_names
    for wheel in control.findall("joint"):
        assert [c.get("name") for c in wheel.findall("command_interface")] == ["velocity"]
        states = [s.get("name") for s in wheel.findall("state_interface")]
        assert states == ["position", "velocity"]


# controllers.yaml


def test_the_controller_has_the_dimensions_and_limits_of_the_robot(robot: Described) -> None:
    parameters = ros_parameters("controllers.yaml", "/**/diff_drive_controller", robot.files)
    names, drive, limits = robot.config.joint_names, CONFIG.drive, CONFIG.limits
    wanted = {
        "left_wheel_names": [name for name in names if "left" in name],
        "right_wheel_names": [name for name in names if "right" in name],
        "wheel_separation": drive.wheel_separation,
        "wheel_radius": drive.wheel_radius,
        "wheel_separation_multiplier": drive.wheel_separation_multiplier,
        "left_wheel_radius_multiplier": drive.left_wheel_radius_multiplier,
        "right_wheel_radius_multiplier": drive.right_wheel_radius_multiplier,
        "odom_frame_id": CONFIG.odometry.odom_frame,
        "base_frame_id": CONFIG.odometry.base_frame,
        "enable_odom_tf": False,
        "linear.x.max_velocity": limits.linear_speed,
        "linear.x.min_velocity": -limits.linear_speed,
        "linear.x.max_acceleration": limits.linear_acceleration,
        "linear.x.max_deceleration": -limits.linear_deceleration,
        "linear.x.max_acceleration_reverse": -limits.linear_acceleration,
        "linear.x.max_deceleration_reverse": limits.linear_deceleration,
        "angular.z.max_velocity": limits.angular_speed,
        "angular.z.min_velocity": -limits.angular_speed,
        "angular.z.max_acceleration": limits.angular_acceleration,
        "angular.z.max_deceleration": -limits.angular_deceleration,
        "angular.z.max_acceleration_reverse": -limits.angular_acceleration,
        "angular.z.max_deceleration_reverse": limits.angular_deceleration,
    }
    assert {key: parameters.get(key) for key in wanted} == wanted
    assert {parameters["cmd_vel_timeout"]} == TIMEOUTS


# nav2_params.yaml


def test_nav2_moves_within_the_limits() -> None:
    limits = CONFIG.limits
    smoother = ros_parameters("nav2_params.yaml", "velocity_smoother")
    fastest = [limits.linear_speed, 0, limits.angular_speed]
    accelerations = [limits.linear_acceleration, 0, limits.angular_acceleration]
    decelerations = [limits.linear_deceleration, 0, limits.angular_deceleration]
    assert smoother["max_velocity"] == fastest
    assert smoother["min_velocity"] == [-v for v in fastest]
    assert smoother["max_accel"] == accelerations
    assert smoother["max_decel"] == [-a for a in decelerations]
    assert {smoother["velocity_timeout"]} == TIMEOUTS
    follow = ros_parameters("nav2_params.yaml", "controller_server")["FollowPath"]
    assert (follow["vx_max"], follow["wz_max"]) == (limits.linear_speed, limits.angular_speed)
    assert (follow["ax_max"], follow["az_max"]) == (accelerations[0], accelerations[2])
    assert follow["ax_min"] == -limits.linear_deceleration
    behaviors = ros_parameters("nav2_params.yaml", "behavior_server")
    assert behaviors["max_rotational_vel"] <= limits.angular_speed
    assert behaviors["rotational_acc_lim"] <= limits.angular_acceleration


def test_nav2_commands_often_enough() -> None:
    controller = ros_parameters("nav2_params.yaml", "controller_server")["controller_frequency"]
    smoother = ros_parameters("nav2_params.yaml", "velocity_smoother")["smoothing_frequency"]
    assert min(controller, smoother) * min(TIMEOUTS) >= 4


def test_nav2s_chain_ends_at_cmd_vel_in_one_type() -> None:
    monitor = ros_parameters("nav2_params.yaml", "collision_monitor")
    assert monitor["cmd_vel_in_topic"] == "cmd_vel_smoothed"
    assert f"/{monitor['cmd_vel_out_topic']}" in published_names("in")
    stamped = [v for k, v in leaves(yaml("nav2_params.yaml")) if k == "enable_stamped_cmd_vel"]
    assert stamped == [False] * 5


def test_nav2_s_servers_have_time_to_answer_on_a_busy_computer() -> None:
    """With Nav2's own 20 ms the robot drove 3.1 m on a goal that was reported as aborted."""
    timeout_ms = ros_parameters("nav2_params.yaml", "bt_navigator")["default_server_timeout"]
    assert type(timeout_ms) is int, "ROS refuses a double where a node declares an integer"
    assert timeout_ms >= 1000


def test_nav2_py_puts_the_robot_s_values_into_nav2_s_file_and_keeps_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    parameters = (
        "controller_frequency: 10.0, FollowPath: {plugin: MPPI, vx_max: 0.5}, plugins: [a, b]"
    )
    nav2 = tmp_path / "nav2.yaml"
    nav2.write_text(f"controller_server: {{ros__parameters: {{{parameters}}}}}\n", encoding="utf-8")
    monkeypatch.setattr(sys, "argv", ["nav2.py", str(nav2), str(FILES / "nav2_params.yaml")])
    runpy.run_path(str(FILES / "nav2.py"))
    printed = capsys.readouterr().out
    # ROS refuses an integer where a node declares a double.
    assert "controller_frequency: 20.0\n" in printed
    controller = YAML(typ="safe").load(printed)["controller_server"]["ros__parameters"]
    assert controller["plugins"] == ["a", "b"]
    assert controller["FollowPath"]["plugin"] == "MPPI"
    assert controller["FollowPath"]["vx_max"] == 1.0


def test_nav2_py_without_its_two_files_says_how_it_is_called(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", ["nav2.py"])
    with pytest.raises(SystemExit, match=r"python3 nav2\.py NAV2_PARAMS"):
        runpy.run_path(str(FILES / "nav2.py"))


def leaves(tree: dict[str, Any]) -> list[tuple[str, Any]]:
    pairs: list[tuple[str, Any]] = []
    for key, value in tree.items():
        pairs += leaves(value) if isinstance(value, dict) else [(key, value)]
    return pairs


# ekf.yaml


def test_the_ekf_takes_the_speeds_of_each_sample_in_the_robot_s_frames() -> None:
    ekf = ros_parameters("ekf.yaml", "ekf_filter_node")
    frames = CONFIG.odometry.odom_frame, CONFIG.odometry.base_frame
    assert (ekf["odom_frame"], ekf["base_link_frame"]) == frames
    assert (ekf["world_frame"], ekf["publish_tf"]) == (ekf["odom_frame"], True)
    assert f"/{ekf['odom0']}" in published_names("out")
    # The places of vx, vy and the speed of yaw. The pose would count the same wheels twice.
    assert [place for place, used in enumerate(ekf["odom0_config"]) if used] == [6, 7, 11]
    assert len(ekf["odom0_config"]) == 15
    assert ekf["frequency"] * ekf["odom0_queue_size"] >= CONFIG.rate_hz
    assert "--params-file deploy/ros2/ekf.yaml" in manual("howto/ros-tools")


# acsar.launch.py


def launched(namespace: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, dict[str, Any]]:
    """Run the launch file with stand-ins for ROS's `launch` and `launch_ros`.

    Returns the launched nodes, keyed by executable.
    """
    modules = ("launch", "launch.actions", "launch.conditions", "launch.substitutions")
    for module in (*modules, "launch_ros", "launch_ros.actions"):
        monkeypatch.setitem(sys.modules, module, MagicMock())
    descriptions = MagicMock(ParameterValue=lambda value, value_type: value)
    monkeypatch.setitem(sys.modules, "launch_ros.parameter_descriptions", descriptions)
    monkeypatch.setattr(sys.modules["launch_ros.actions"], "Node", lambda **kwargs: kwargs)
    monkeypatch.setattr(
        sys.modules["launch.substitutions"],
        "LaunchConfiguration",
        lambda name: MagicMock(perform=lambda context: namespace),
    )
    launch = runpy.run_path(str(FILES / "acsar.launch.py"))
    launch["generate_launch_description"]()
    return {node["executable"]: node for node in launch["nodes"](MagicMock())}


def hardware(nodes: dict[str, dict[str, Any]]) -> dict[str | None, str | None]:
    """Return the hardware plugin's parameters from the published description."""
    text = nodes["robot_state_publisher"]["parameters"][0]["robot_description"]
    return {p.get("name"): p.text for p in ET.fromstring(text).findall("ros2_control//param")}


def resolved(topic: str, namespace: str, remappings: list[tuple[str, str]]) -> str:
    """Return the full name of a topic in a ROS process with these remappings.

    The remappings apply to every node of the process.
    """

    def full(name: str) -> str:
        return name if name.startswith("/") else f"{namespace and '/' + namespace}/{name}"

    return next((full(to) for name, to in remappings if full(name) == full(topic)), full(topic))


SPACES = pytest.mark.parametrize(("namespace", "prefix"), [("", ""), ("robot1", "/robot1")])


@SPACES
def test_the_launch_file_puts_the_namespace_before_every_topic(
    namespace: str, prefix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes = launched(namespace, monkeypatch)
    assert set(nodes) == {"robot_state_publisher", "ros2_control_node", "spawner", "rviz2"}
    assert {node["namespace"] for node in nodes.values()} == {namespace}
    assert {name for name, node in nodes.items() if "condition" not in node} == {
        "robot_state_publisher"
    }
    parameters = hardware(nodes)
    assert parameters["joint_commands_topic"] == f"{prefix}/joint_commands"
    assert parameters["joint_states_topic"] == f"{prefix}/joint_states"
    remappings = nodes["spawner"]["arguments"][-1]
    assert f"~/cmd_vel:={prefix}/cmd_vel" in remappings
    assert f"~/odom:={prefix}/odom" not in remappings


@SPACES
def test_ros2_control_uses_the_robot_s_joint_topics_in_the_right_direction(
    namespace: str, prefix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Check the remappings of ros2_control_node, because the controller runs inside its process."""
    nodes = launched(namespace, monkeypatch)
    manager, parameters = nodes["ros2_control_node"], hardware(nodes)
    ours = {f"{prefix}/{row.name}": row.direction for row in ros_names()}
    for parameter, direction in (("joint_states_topic", "out"), ("joint_commands_topic", "in")):
        topic = resolved(str(parameters[parameter]), namespace, manager["remappings"])
        assert ours.get(topic) == direction, topic
    for topic in ("/tf", "/tf_static"):
        assert resolved(topic, namespace, manager["remappings"]) == f"{prefix}{topic}"


# zenoh-bridge-ros2dds.json5


def test_the_bridge_connects_as_a_client_to_the_daemon_s_endpoints() -> None:
    text = (FILES / "zenoh-bridge-ros2dds.json5").read_text()
    zenoh.Config.from_json5(text)
    assert bridge_setting("mode") == "client"
    assert bridge_setting("connect/endpoints") == list(CONFIG.bus.listen)
    assert bridge_setting("connect/timeout_ms") == -1
    assert bridge_setting("scouting/multicast/enabled") is False
    assert bridge_setting("plugins/ros2dds/domain") == RosConfig().domain


def test_the_bridge_passes_exactly_the_topics_and_services_of_the_daemon() -> None:
    allow = bridge_setting("plugins/ros2dds/allow")
    services = {f"/{row.name}" for row in ros_names() if row.direction in ("service", "query")}
    wanted = {
        "publishers": published_names("in"),
        "subscribers": published_names("out"),
        "service_clients": services,
        "service_servers": set(),
        "action_servers": set(),
        "action_clients": set(),
    }
    assert {kind: set(names) for kind, names in allow.items()} == wanted
    assert all(len(names) == len(set(names)) for names in allow.values())
    assert bridge_setting("plugins/ros2dds/pub_priorities")[0] == "/stop_request=1:express"
    assert wanted["subscribers"] == {f"/{row.ros}" for row in promised.PUBLISHED if row.ros}
    assert {f"/acsard/{name}" for name in promised.TRIGGERS} < services


# diagnostics.yaml


def groups() -> dict[str, dict[str, Any]]:
    parameters = ros_parameters("diagnostics.yaml", "analyzers")
    return {name: value for name, value in parameters.items() if isinstance(value, dict)}


def row_names() -> list[str]:
    """Return the name of every row that acsard can publish on `diagnostics`."""
    config = replace(CONFIG, bus=BusConfig(connect=("tcp/a:7447",)))
    snapshot = changed(
        SNAPSHOT,
        gyro="used",
        recording=Recording("/somewhere"),
        latch_file="",
        board={"emergency_stop": "released"},
    )
    rows = diagnostics(
        config, OUTPUTS.now, snapshot, reason("certificate_valid", where="", days=365, of="")
    ).status
    return [row.name for row in rows]


def test_each_row_of_diagnostics_falls_into_exactly_one_group_of_the_aggregator() -> None:
    """The aggregator puts a row into a group if its name begins with an entry of `startswith`."""
    names = row_names()
    assert len(set(names)) == 13
    for name in names:
        matches = [
            group
            for group, analyzer in groups().items()
            if any(name.find(start) == 0 for start in analyzer["startswith"])
        ]
        assert len(matches) == 1, name
    for analyzer in groups().values():
        for start in analyzer["startswith"]:
            assert any(name.startswith(start) for name in names), start


def test_a_diagnostics_row_at_its_normal_rate_is_not_stale_for_the_aggregator() -> None:
    for analyzer in groups().values():
        assert analyzer["type"] == "diagnostic_aggregator/GenericAnalyzer"
        assert analyzer["timeout"] > 2 / DIAGNOSTICS_HZ
        (prefix,) = analyzer["remove_prefix"]
        assert all(start.startswith(prefix) for start in analyzer["startswith"])


# the pages


def test_the_readme_names_every_file() -> None:
    text = (FILES / "README.md").read_text()
    for path in FILES.iterdir():
        if path.is_file() and path.name != "README.md":
            assert f"`{path.name}`" in text, path.name


def test_the_manual_has_every_ros_key_with_its_default() -> None:
    text = manual("howto/ros")
    for field in msgspec.structs.fields(RosConfig):
        default = json.dumps(field.default)
        assert re.search(rf"^{field.name} = {re.escape(default)}( |$)", text, re.M), field.name


def test_the_manual_names_every_topic_and_service() -> None:
    text = manual("reference/ros")
    for row in ros_names():
        if not row.type.startswith("rcl_interfaces/"):
            assert f"`{row.name}`" in text, row.name


def test_the_manual_starts_a_bridge_over_the_network_below_the_robot_s_namespace() -> None:
    """Over the network each robot has a namespace.

    A bridge without this namespace would show ROS nothing of the robot.
    """
    lines = re.findall(r"^zenoh-bridge-ros2dds .*-e .*$", manual("howto/ros"), re.M)
    assert lines
    assert all(" -n /robot1" in line for line in lines)


def test_drive_py_begins_and_ends_with_zeros() -> None:
    """Over the bridge a sender is armed only if it sends no speed for a second after its zero.

    The zeros therefore continue for longer than a second.
    """
    text = (FILES / "drive.py").read_text()
    (zeros,) = re.findall(r"^ZEROS_S = ([\d.]+)$", text, re.M)
    assert float(zeros) > NEUTRAL_PAUSE_NS / NS_PER_S + min(TIMEOUTS)
