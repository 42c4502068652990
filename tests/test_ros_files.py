"""The files in deploy/ros2 describe the robot to ROS with the same numbers as acsard's defaults.

Those that `describe.py` writes do it with the numbers of another robot.

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
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import MagicMock

import msgspec
import pytest
import zenoh
from msgspec.structs import replace
from ruamel.yaml import YAML

from acsard.core.codes import reason
from acsard.core.config.parsing import effective
from acsard.core.config.settings import (
    DIAGNOSTICS_HZ,
    BusConfig,
    Config,
    DriveConfig,
    JointsConfig,
    LidarConfig,
    LimitsConfig,
    OdometryConfig,
    RosConfig,
    WheelMap,
)
from acsard.core.messages.diagnostics import diagnostics
from acsard.core.motion.neutral import NEUTRAL_PAUSE_NS
from acsard.core.ros.transports import ros_names
from acsard.core.values import NS_PER_S, Recording
from tests import promised
from tests.unit.examples import OUTPUTS, SNAPSHOT, changed

FILES = Path(__file__).parents[1] / "deploy" / "ros2"
LAUNCH = FILES / "acsar.launch.py"
CONFIG = Config()


def manual(page: str) -> str:
    """Return the text of a page of the manual."""
    return (FILES.parent / f"manual/pages/{page}.md").read_text()


# Another robot, of which no value that the files have is a default.
OTHER = Config(
    drive=DriveConfig(
        wheel_radius=0.0825,
        wheel_separation=0.46,
        wheel_separation_multiplier=1.52,
        left_wheel_radius_multiplier=1.01,
        right_wheel_radius_multiplier=0.99,
    ),
    joints=JointsConfig(
        front_right="fr_joint", front_left="fl_joint", rear_left="rl_joint", rear_right="rr_joint"
    ),
    limits=LimitsConfig(
        linear_speed=0.7,
        angular_speed=0.9,
        linear_acceleration=0.5,
        angular_acceleration=1.25,
        linear_deceleration=0.8,
        angular_deceleration=2.0,
        wheel_speed=14.5,
    ),
    odometry=OdometryConfig(odom_frame="robot1/odom", base_frame="robot1/base"),
    lidar=LidarConfig(
        lidar_frame="robot1/laser", lidar_x_offset=0.12, lidar_y_offset=-0.03, lidar_yaw=1.5
    ),
)
TWO = replace(CONFIG, mcu=replace(CONFIG.mcu, wheels=WheelMap(left="+l", right="+r")))

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


@pytest.fixture(scope="module", params=["four wheels", "two wheels", "another robot"])
def robot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Described:
    """Return the robot of the defaults, or one whose files `describe.py` has written."""
    if request.param == "four wheels":
        return Described(CONFIG, FILES)
    config = TWO if request.param == "two wheels" else OTHER
    where = tmp_path_factory.mktemp("described")
    (where / "robot.json").write_bytes(msgspec.json.encode(effective(config)))
    words = [sys.executable, str(FILES / "describe.py"), "robot.json", "my_robot"]
    subprocess.run(words, cwd=where, check=True, timeout=20)
    for name in ("acsar.launch.py", "acsar.rviz", "nav2.py"):
        assert (where / "my_robot" / name).read_bytes() == (FILES / name).read_bytes()
    return Described(config, where / "my_robot")


def side_of(config: Config, joint: str) -> int:
    """Return the sign of a wheel's y."""
    joints = config.joints
    return 1 if joint in (joints.front_left, joints.rear_left, joints.left) else -1


def end_of(config: Config, joint: str) -> int:
    """Return the sign of a wheel's x."""
    joints = config.joints
    if joint in (joints.left, joints.right):
        return 0
    return 1 if joint in (joints.front_left, joints.front_right) else -1


def link(frame: str) -> str:
    """Return the link of the URDF, to which robot_state_publisher adds `frame_prefix`."""
    return frame.rpartition("/")[2]


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


# describe.py


@pytest.mark.parametrize(
    ("file", "text", "missing"),
    [
        ("acsar.urdf", 'velocity="40.0"', "velocity="),
        ("acsar.urdf", 'radius="0.05"', "radius="),
        ("acsar.urdf", '"lidar_link"', "lidar_link"),
        ("acsar.urdf", '"base_link"', "base_link"),
        ("acsar.urdf", "front_left_wheel_joint", "front_left_wheel_joint"),
        ("acsar.urdf", "<!--\n  The robot", "<!--"),
        ("nav2_params.yaml", "global_frame: odom", "global_frame"),
        ("nav2_params.yaml", "base_footprint", "base_footprint"),
        ("ekf.yaml", "world_frame:", "world_frame"),
    ],
)
def test_a_value_that_finds_no_place_in_a_file_ends_describe_py(
    file: str, text: str, missing: str, tmp_path: Path
) -> None:
    shutil.copytree(FILES, tmp_path, dirs_exist_ok=True)
    (tmp_path / "robot.json").write_bytes(msgspec.json.encode(effective(CONFIG)))
    (tmp_path / file).write_text((tmp_path / file).read_text().replace(text, "other"))
    words = [sys.executable, "describe.py", "robot.json", "my_robot"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=20)
    assert done.returncode == 1
    assert re.search(f"no text that fits .*{missing}.*take all files", done.stderr)
    assert not (tmp_path / "my_robot").exists()


# acsar.urdf


def test_each_wheel_touches_the_floor_at_half_the_wheel_separation(robot: Described) -> None:
    drive = robot.config.drive
    radius, half = drive.wheel_radius, drive.wheel_separation / 2
    wheels = [j.get("name") for j in robot.urdf().findall("joint[@type='continuous']")]
    assert tuple(wheels) == robot.config.joint_names
    for name in robot.config.joint_names:
        joint = robot.joint(name)
        assert find_only(joint, "parent").get("link") == link(robot.config.odometry.base_frame)
        x, y, z = numbers(find_only(joint, "origin").get("xyz"))
        assert (y, z) == pytest.approx((side_of(robot.config, name) * half, radius))
        assert (x > 0) - (x < 0) == end_of(robot.config, name)
        assert numbers(find_only(joint, "axis").get("xyz")) == [0, 1, 0]
        limit = find_only(joint, "limit").get("velocity")
        assert numbers(limit) == [robot.config.limits.wheel_speed]
    tyres = robot.urdf().findall("link//cylinder[@length='0.04'][@radius]")
    radii = {tyre.get("radius") for tyre in tyres} - {"0.035"}  # the lidar's
    assert radii == {f"{radius:g}"}


def test_each_link_has_a_joint_to_it_and_none_is_left_over(robot: Described) -> None:
    links = {link.get("name") for link in robot.urdf().findall("link")}
    joints = robot.urdf().findall("joint")
    children = [find_only(joint, "child").get("link") for joint in joints]
    root = link(robot.config.odometry.base_frame)
    assert sorted([*map(str, children), root]) == sorted(map(str, links))


def test_lidar_and_footprint_frames_agree_with_the_configuration(robot: Described) -> None:
    lidar = robot.config.lidar
    for name, xyz, rpy in (
        (link(lidar.lidar_frame), [lidar.lidar_x_offset, lidar.lidar_y_offset, 0],
         [0, 0, lidar.lidar_yaw]),
        ("base_footprint", [0, 0, 0], [0, 0, 0]),
    ):  # fmt: skip
        fixed_joint = robot.joint_to(name)
        root = link(robot.config.odometry.base_frame)
        assert find_only(fixed_joint, "parent").get("link") == root
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


def agree(name: str, parameters: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Compare the values of a file of `deploy/ros2` with those of the robot."""
    differ = {
        key: (parameters.get(key), v) for key, v in wanted.items() if parameters.get(key) != v
    }
    assert not differ, f"deploy/ros2/{name} has other values than the configuration: {differ}"


def test_the_controller_has_the_dimensions_and_limits_of_the_robot(robot: Described) -> None:
    parameters = ros_parameters("controllers.yaml", "/**/diff_drive_controller", robot.files)
    config, names = robot.config, robot.config.joint_names
    drive, limits = config.drive, config.limits
    wanted = {
        "left_wheel_names": [name for name in names if side_of(config, name) > 0],
        "right_wheel_names": [name for name in names if side_of(config, name) < 0],
        "wheel_separation": drive.wheel_separation,
        "wheel_radius": drive.wheel_radius,
        "wheel_separation_multiplier": drive.wheel_separation_multiplier,
        "left_wheel_radius_multiplier": drive.left_wheel_radius_multiplier,
        "right_wheel_radius_multiplier": drive.right_wheel_radius_multiplier,
        "odom_frame_id": config.odometry.odom_frame,
        "base_frame_id": config.odometry.base_frame,
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
    agree("controllers.yaml", parameters, wanted)
    assert {parameters["cmd_vel_timeout"]} == TIMEOUTS


# nav2_params.yaml


def test_nav2_moves_within_the_limits(robot: Described) -> None:
    limits = robot.config.limits
    smoother = ros_parameters("nav2_params.yaml", "velocity_smoother", robot.files)
    fastest = [limits.linear_speed, 0, limits.angular_speed]
    accelerations = [limits.linear_acceleration, 0, limits.angular_acceleration]
    decelerations = [limits.linear_deceleration, 0, limits.angular_deceleration]
    agree("nav2_params.yaml", smoother, {
        "max_velocity": fastest,
        "min_velocity": [-v for v in fastest],
        "max_accel": accelerations,
        "max_decel": [-a for a in decelerations],
    })  # fmt: skip
    assert {smoother["velocity_timeout"]} == TIMEOUTS
    follow = ros_parameters("nav2_params.yaml", "controller_server", robot.files)["FollowPath"]
    agree("nav2_params.yaml", follow, {
        "vx_max": limits.linear_speed,
        "wz_max": limits.angular_speed,
        "ax_max": limits.linear_acceleration,
        "az_max": limits.angular_acceleration,
        "ax_min": -limits.linear_deceleration,
    })  # fmt: skip
    behaviors = ros_parameters("nav2_params.yaml", "behavior_server", robot.files)
    assert behaviors["max_rotational_vel"] <= limits.angular_speed
    assert behaviors["rotational_acc_lim"] <= limits.angular_acceleration


def test_nav2_has_the_frames_and_the_outline_of_the_robot(robot: Described) -> None:
    odom, base = robot.config.odometry.odom_frame, robot.config.odometry.base_frame
    found: dict[str, set[Any]] = {}
    for key, value in leaves(yaml("nav2_params.yaml", robot.files)):
        found.setdefault(key, set()).add(str(value))
    below = f"{base.removesuffix(link(base))}base_footprint"
    assert found["base_frame_id"] == {below}
    assert found["robot_base_frame"] == found["base_frame"] == {base}
    assert found["odom_frame_id"] == found["local_frame"] == found["fixed_frame"] == {odom}
    assert found["global_frame"] == {odom, "map"}
    (footprint,) = found["footprint"]
    corners = json.loads(footprint)
    half = robot.config.drive.wheel_separation / 2 + 0.02
    length = max(0.17, 0.12 + robot.config.drive.wheel_radius)
    assert [abs(n) for corner in corners for n in corner] == pytest.approx(4 * [length, half])


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


def test_the_ekf_takes_the_speeds_of_each_sample_in_the_robot_s_frames(robot: Described) -> None:
    ekf = ros_parameters("ekf.yaml", "/**/ekf_filter_node", robot.files)
    frames = robot.config.odometry.odom_frame, robot.config.odometry.base_frame
    assert (ekf["odom_frame"], ekf["base_link_frame"]) == frames
    assert (ekf["world_frame"], ekf["publish_tf"]) == (ekf["odom_frame"], True)
    assert f"/{ekf['odom0']}" in published_names("out")
    # The places of vx, vy and the speed of yaw. The pose would count the same wheels twice.
    assert [place for place, used in enumerate(ekf["odom0_config"]) if used] == [6, 7, 11]
    assert len(ekf["odom0_config"]) == 15
    assert ekf["frequency"] * ekf["odom0_queue_size"] >= CONFIG.rate_hz
    assert "--params-file deploy/ros2/ekf.yaml" in manual("howto/ros-tools")


# acsar.launch.py


def launched(
    namespace: str, monkeypatch: pytest.MonkeyPatch, **arguments: str
) -> dict[str, dict[str, Any]]:
    """Run the launch file with stand-ins for ROS's `launch` and `launch_ros`.

    Returns the launched nodes, keyed by executable.
    """
    given = {"namespace": namespace} | arguments
    modules = ("launch", "launch.actions", "launch.conditions", "launch.substitutions")
    for module in (*modules, "launch_ros", "launch_ros.actions"):
        monkeypatch.setitem(sys.modules, module, MagicMock())
    descriptions = MagicMock(ParameterValue=lambda value, value_type: value)
    monkeypatch.setitem(sys.modules, "launch_ros.parameter_descriptions", descriptions)
    monkeypatch.setattr(sys.modules["launch_ros.actions"], "Node", lambda **kwargs: kwargs)
    monkeypatch.setattr(
        sys.modules["launch.substitutions"],
        "LaunchConfiguration",
        lambda name: MagicMock(perform=lambda context: given.get(name, "")),
    )
    launch = runpy.run_path(str(LAUNCH))
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


def test_two_robots_with_a_frame_prefix_share_one_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = launched("robot1", monkeypatch, frame_prefix="robot1/")
    publisher = nodes["robot_state_publisher"]
    assert publisher["parameters"][0]["frame_prefix"] == "robot1/"
    for name in ("robot_state_publisher", "rviz2"):
        assert resolved("/tf", "robot1", nodes[name]["remappings"]) == "/tf"
    page = manual("howto/ros-tools")
    assert "frame_prefix:=robot1/" in page
    assert "topic_tools relay /robot1/tf /tf" in page


def test_only_a_bag_has_another_clock_than_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    for given, value in (({}, False), ({"use_sim_time": "true"}, True)):
        for name, node in launched("", monkeypatch, **given).items():
            if name != "spawner":
                assert {"use_sim_time": value} in node["parameters"], name


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
        config, OUTPUTS.now, snapshot, reason("certificate_valid", where="", span="365 days", of="")
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
