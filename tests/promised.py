"""The keys that the pages promise, written down independently of the product's own table.

The tests compare this list with `TOPICS` of the product, and take their expectations from here. A
new key or service therefore needs one row here.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from acsard.core.values import Role


class Promise(NamedTuple):
    """A key of the robot, without the robot's id."""

    key: str
    direction: Literal["out", "in", "service", "query"]
    type: str
    role: Role | None
    """The least role that may use the key; None if only programs on the robot's computer may."""
    ros: str = ""
    """Name of the topic or service in ROS without the namespace; "" if ROS has none."""
    always: bool = True
    """Whether a real robot with the default configuration offers the key."""


PROMISED = (
    Promise("odom", "out", "Odometry", "viewer", "odom"),
    Promise("tf", "out", "TFMessage", "viewer", "tf"),
    Promise("tf_static", "out", "TFMessage", "viewer", "tf_static"),
    Promise("wheel_states", "out", "JointState", "viewer", "joint_states"),
    Promise("battery", "out", "Battery", "viewer", "battery_state"),
    Promise("cmd_vel_out", "out", "TwistStamped", "viewer", "cmd_vel_out"),
    Promise("state", "out", "RobotState", "viewer"),
    Promise("diagnostics", "out", "DiagnosticArray", "viewer", "diagnostics"),
    Promise("events", "out", "Events", "viewer"),
    Promise("beat", "out", "Beat", "viewer"),
    Promise("sim/pose", "out", "PoseStamped", "viewer", always=False),
    Promise("json/<key>", "out", "JSON", "viewer"),
    Promise("cmd/<source>", "in", "Twist or TwistStamped", None),
    Promise("wheel_cmd/<source>", "in", "JointState", None),
    Promise("cmd/<source>/<certificate>", "in", "Twist or TwistStamped", "operator"),
    Promise("wheel_cmd/<source>/<certificate>", "in", "JointState", "operator"),
    Promise("imu", "in", "Imu", "maintainer", "imu/data", always=False),
    Promise("speed_limit", "in", "SpeedLimit", "operator", "speed_limit"),
    Promise("stop", "in", "anything", "viewer", "stop_request"),
    Promise("gateway", "in", "GatewayState", None),
    Promise("srv/stop", "service", "ServiceReply", "viewer", "acsard/stop"),
    Promise("srv/clear", "service", "ServiceReply", "operator", "acsard/clear"),
    Promise("srv/activate", "service", "ServiceReply", "operator", "acsard/activate"),
    Promise("srv/deactivate", "service", "ServiceReply", "operator", "acsard/deactivate"),
    Promise("srv/reset_odometry", "service", "ServiceReply", "operator", "acsard/reset_odometry"),
    Promise("srv/set_pose", "service", "ServiceReply", "maintainer"),
    Promise("srv/set", "service", "ServiceReply", "maintainer"),
    Promise("srv/<verb>", "service", "ServiceReply", None),
    Promise("info", "query", "Info", "viewer"),
    Promise("config", "query", "Config", "maintainer"),
    Promise("interfaces", "query", "Interfaces", "viewer"),
    Promise("topics", "query", "Topics", "viewer"),
    Promise("schema/<Type>", "query", "JSON Schema", "viewer"),
    Promise("whoami/<role>", "query", "WhoAmI", "operator"),
    Promise("alive", "out", "liveliness token", "viewer"),
)

PUBLISHED = tuple(
    row for row in PROMISED if row.direction == "out" and row.key not in ("alive", "json/<key>")
)
"""The keys on which the robot publishes messages."""

SERVICES = {
    row.key.removeprefix("srv/"): row
    for row in PROMISED
    if row.direction == "service" and row.key != "srv/<verb>"
}
"""The services, by their names."""

TRIGGERS = tuple(name for name, row in SERVICES.items() if row.ros)
"""The names of the services that ROS can call, because they have no payload."""
