"""Starts the ROS side of the robot: its description and, on request, ros2_control and RViz.

This file does not start acsard, which runs without ROS, as a service on the robot.

    ros2 launch ./acsar.launch.py [use_ros2_control:=true] [use_rviz:=true] [namespace:=robot1]
        [frame_prefix:=robot1/] [use_sim_time:=true]
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

HERE = Path(__file__).resolve().parent
URDF = HERE / "acsar.urdf"
CONTROLLERS = HERE / "controllers.yaml"
RVIZ = HERE / "acsar.rviz"

# tf2 publishes on /tf, with a leading slash. acsard and the bridge put TF into the robot's
# namespace, like all other topics. In the root namespace these remappings change nothing. With
# prefixed frames all robots share one tree on /tf.
TF = [("/tf", "tf"), ("/tf_static", "tf_static")]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "use_ros2_control",
                default_value="false",
                description="drive the wheels through diff_drive_controller (controllers.yaml)",
            ),
            DeclareLaunchArgument(
                "use_rviz", default_value="false", description="open RViz with acsar.rviz"
            ),
            DeclareLaunchArgument(
                "namespace",
                default_value="",
                description="ROS namespace of the robot: [ros] namespace of acsard.toml",
            ),
            DeclareLaunchArgument(
                "frame_prefix",
                default_value="",
                description="the part of the frames in acsard.toml before base_link, such as "
                "robot1/, for several robots in one tree of frames",
            ),
            DeclareLaunchArgument(
                "use_sim_time",
                default_value="false",
                description="only for a bag with --clock: acsard has the time of its host",
            ),
            OpaqueFunction(function=nodes),
        ]
    )


def nodes(context: LaunchContext) -> list[Node]:
    namespace = LaunchConfiguration("namespace").perform(context).strip("/")
    with_control = IfCondition(LaunchConfiguration("use_ros2_control"))
    with_rviz = IfCondition(LaunchConfiguration("use_rviz"))
    prefix = f"/{namespace}" if namespace else ""
    frames = LaunchConfiguration("frame_prefix").perform(context)
    tf = [] if frames else TF
    clock = {"use_sim_time": LaunchConfiguration("use_sim_time").perform(context) == "true"}
    return [
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            namespace=namespace,
            parameters=[
                {
                    "robot_description": ParameterValue(description(prefix), value_type=str),
                    "publish_frequency": 50.0,
                    "frame_prefix": frames,
                },
                clock,
            ],
            remappings=tf,
            output="both",
        ),
        # Since Jazzy, the controller manager takes the URDF from the topic robot_description. The
        # hardware's node runs in the same process, so each remapping here applies to that node too.
        # Do not remap joint_states, because the hardware reads the wheel speeds from that topic.
        Node(
            package="controller_manager",
            executable="ros2_control_node",
            namespace=namespace,
            parameters=[str(CONTROLLERS), clock],
            remappings=tf,
            output="both",
            condition=with_control,
        ),
        # The controller subscribes to the cmd_vel on which all nodes publish. Its odometry gets
        # another topic than acsard's. Both remappings are in one argument, because not every
        # version accepts --controller-ros-args twice.
        Node(
            package="controller_manager",
            executable="spawner",
            namespace=namespace,
            arguments=[
                "diff_drive_controller",
                "--param-file",
                str(CONTROLLERS),
                "--controller-ros-args",
                f"-r ~/cmd_vel:={prefix}/cmd_vel -r ~/odom:={prefix}/ros2_control/odom",
            ],
            output="both",
            condition=with_control,
        ),
        Node(
            package="rviz2",
            executable="rviz2",
            namespace=namespace,
            arguments=["-d", str(RVIZ)],
            parameters=[clock],
            remappings=[
                *tf,
                ("/odom", "odom"),
                ("/scan", "scan"),
                ("/robot_description", "robot_description"),
            ],
            output="log",
            condition=with_rviz,
        ),
    ]


def description(prefix: str) -> str:
    """Return the URDF with `prefix`, the namespace, before the two topics of the hardware.

    These two topics are absolute, so a namespace has no effect on them otherwise.
    """
    text = URDF.read_text(encoding="utf-8")
    for topic in ("/joint_commands", "/joint_states"):
        text = text.replace(f">{topic}</param>", f">{prefix}{topic}</param>")
    return text
