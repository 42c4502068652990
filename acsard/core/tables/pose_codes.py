"""The codes of the pose: why it may be far off although the link is up."""

from __future__ import annotations

from typing import Literal

from acsard.core.tables.finding_table import table

PoseCode = Literal[
    "counts_and_speeds_differ", "wheels_and_commands_differ", "encoder_counts_missing",
    "coarse_encoder", "gyro_disagrees", "not_calibrated",
]  # fmt: skip

# By the state of the gyro; `gyro_disagrees` is above.
GyroCode = Literal[
    "gyro_waiting_for_rest", "gyro_waiting_for_turn", "gyro_used", "gyro_silent", "gyro_hangs",
    "gyro_reversed", "gyro_in_degrees", "gyro_dead", "gyro_not_believed",
]  # fmt: skip

POSE = table(
    Literal[PoseCode, GyroCode],
    """
WARN counts_and_speeds_differ | pose doubtful
    the board's counts and its speeds contradict each other, so mcu.encoder_counts is wrong, or the
    firmware computes wrong speeds; the pose uses the counts, and its uncertainty the difference:
    -> write the counts per turn of a wheel that `acsard mcu check` shows; if they are right,
    correct the speeds in the firmware
WARN wheels_and_commands_differ | pose doubtful
    the wheels report another motion than was commanded, so the motors are blocked, too weak or too
    strong, or the board reports wrong speeds; the pose follows the wheels:
    -> repair the wheel that a fault has named. Else measure a straight drive with a tape: if the
    pose is wrong, correct the encoders or the speeds in the firmware, else the speed control of
    the motors. Then type `acsard call set_pose`, which ends this warning
WARN encoder_counts_missing | pose doubtful
    the speeds jump as those of coarse encoders do, and mcu.encoder_counts is not set, so the
    heading drifts, and damaged lines are not noticed:
    -> write the counts per turn of a wheel; `acsard mcu check` shows about how many they are
WARN gyro_disagrees | pose doubtful
    gyro and wheels measure different turns: the heading is the gyro's, and its uncertainty includes
    the difference:
    -> if the wheels do not slip, measure the track with `acsard calibrate drive`, let the robot
    stand so that it learns the gyro's bias, and check that the gyro's z axis points up and that it
    sends rad/s
WARN not_calibrated | not calibrated
    the robot is not calibrated, so the heading by its wheels is uncertain:
    -> type `acsard calibrate drive`
WARN coarse_encoder | pose doubtful
    the encoders are coarse, and lines get lost or come after varying delays, so the pose may be far
    off:
    -> flash the C firmware of deploy/firmware, and write mcu.link_check = "on" and
    mcu.encoder_counts: its lines have counts, which no lost or late line can falsify
OK gyro_waiting_for_rest
    the gyro's bias is not known yet: the robot must stand for {seconds:.1f} s, in which the gyro
    reports {samples} rates of at most {most} rad/s
OK gyro_waiting_for_turn
    the heading comes from the wheels until the gyro has agreed with them in a turn
OK gyro_used
    the heading comes from the gyro
WARN gyro_silent
    the gyro is silent: the heading comes from the wheels
    -> check that the gyro's driver runs, and that it publishes on the Zenoh key `imu` (the ROS
    topic imu/data)
WARN gyro_hangs
    the gyro repeats one rate exactly, so it hangs: the heading comes from the wheels
    -> check the gyro's cable and its driver: angular_velocity.z must change in its last digits even
    at rest
WARN gyro_reversed
    the gyro is not used, because it reports a left turn of the robot as a right turn
    -> check with `acsard mcu check` that the wheels turn the right way; if they do, mount the gyro
    with its z axis up, or let its driver negate angular_velocity.z
WARN gyro_in_degrees
    the gyro is not used, because its rate is 57 times too high: it sends degrees per second, and
    must send radians per second
    -> let the gyro's driver send rad/s: divide the degrees per second by 57.3
WARN gyro_dead
    the gyro is not used, because it measures no turn while the wheels turn the robot
    -> check the gyro's cable and its driver: angular_velocity.z must change when the robot turns
WARN gyro_not_believed
    the gyro is not used, because it measures much larger turns than the wheels
    -> check that the gyro's z axis points up, that its driver sends rad/s, and that its bias has
    not changed; then measure the track width with `acsard calibrate drive`
""",
)
