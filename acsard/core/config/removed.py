"""The settings of earlier versions that acsard no longer has, with what to do instead.

To be dropped after 0.3.
"""

from __future__ import annotations

_LIDAR = "describe the lidar in the URDF and set lidar.publish_tf = false"
_SIDES = "remove the key: odometry.wheel_radius_ratio_std is of both sides"
_AXES = "remove the key: axes that wheels do not measure always have the variance 1e6"
_RATE = "remove the key; rates.telemetry is the highest rate of all messages but odom and tf"
_SIM = "remove the key: the simulated robot has an ideal gyro, even wheels and a dry floor"

REMOVED = {
    "control.auto_activate": "remove the key: `acsard call deactivate` lasts over restarts",
    "feedback.wheel_acceleration": "remove the key: the bound is 1500 rad/s2",
    "feedback.fault_time": "remove the key: feedback.response_time bounds how late a wheel obeys",
    "battery.return_below": "remove the key: use battery.warning_below",
    "battery.hysteresis": "remove the key: a level ends 0.5 V or % above its threshold",
    "commands.neutral_first": 'remove the key: a source may have neutral_first = "pause"',
    "commands.neutral_pause": "remove the key: the pause is 1 s",
    "record.days": "remove the key: only record.megabytes limits the recordings",
    "log.format": "remove the key: the format follows from the terminal, the journal or a pipe",
    "footprint": "remove this table, and give the URDF a fixed joint base_link -> base_footprint",
    "lidar.lidar_z_offset": _LIDAR,
    "lidar.lidar_roll": _LIDAR,
    "lidar.lidar_pitch": _LIDAR,
    "odometry.learned_track": "remove the key; `acsard calibrate` measures the track",
    "odometry.covariance": "remove the key: the daemon always computes the covariances",
    "odometry.left_wheel_radius_multiplier_std": _SIDES,
    "odometry.right_wheel_radius_multiplier_std": _SIDES,
    "odometry.wheel_slip_std": "remove the key: odometry.distance_scale_std includes slip",
    "odometry.pose_covariance_diagonal": _AXES,
    "odometry.twist_covariance_diagonal": _AXES,
    "rates.wheel_states": _RATE,
    "rates.cmd_vel_out": _RATE,
    "rates.state": _RATE,
    "rates.diagnostics": _RATE,
    "ros.announce": "remove the key: the topics of the bridge are always announced",
    "ros.node": 'remove the key: the node is "acsard", and ros.namespace tells robots apart',
    "ros.urdf": "remove the key: robot_state_publisher publishes robot_description",
    "ros.cmd_vel_type": "remove the key: cmd_vel accepts Twist and TwistStamped",
    "sim.boot_time": _SIM,
    "sim.left_radius_multiplier": _SIM,
    "sim.right_radius_multiplier": _SIM,
    "sim.track_rate_dependence": _SIM,
    "sim.turn_slip": _SIM,
    "sim.gyro_bias": _SIM,
    "sim.gyro_noise": _SIM,
    "sim.gyro_delay": _SIM,
    "sim.seed": _SIM,
}  # One line each: the advice completes the sentence "This setting no longer exists: ..."


def why_removed(key: str) -> str | None:
    """Return one sentence that says what to do instead of `key`, a dotted key or a table.

    Return None if the key was not removed.
    """
    advice = REMOVED.get(key) or REMOVED.get(key.partition(".")[0])
    return f"this setting no longer exists; {advice}" if advice else None
