"""The codes of motors and wheels, and of the guard that checks each line to them."""

from __future__ import annotations

from typing import Literal

from acsard.core.tables.finding_table import table

# For which the guard replaces a line; each is a defect of acsard.
GuardCode = Literal[
    "guard_line_damaged", "guard_too_fast", "guard_no_link", "guard_no_checksum",
    "guard_no_command", "guard_too_long",
]  # fmt: skip

GUARD_DEFECTS: dict[GuardCode, str] = {
    "guard_line_damaged": "is not complete, or does not have the speed of each wheel",
    "guard_too_fast": "moves a wheel faster than limits.wheel_speed",
    "guard_no_link": "moves a wheel while the serial link is not up",
    "guard_no_checksum": "moves a wheel without the checksum that mcu.link_check requires",
    "guard_no_command": "speeds up a wheel although no command is fresh, or although the mode is "
    "not driving",
    "guard_too_long": "still moves a wheel although the longest ramp to zero has ended",
}

# Causes of a latched fault.
FaultCode = Literal[
    GuardCode, "driver_fault", "impossible_speeds", "wheel_reversed", "wheel_runaway",
    "wheel_too_fast", "wheels_swapped", "no_wheel_moves", "no_wheel_begins",
]  # fmt: skip

# Trouble of a wheel that does not stop the robot.
WheelCode = Literal["wheel_blocked", "wheel_slow", "wheel_fast"]

MotorCode = Literal[FaultCode, WheelCode, "wheels_obey", "wheel_fault", "no_encoders"]

MOTORS = table(
    MotorCode,
    """
FAIL driver_fault
    the board reports a fault of a motor driver
    -> let the driver cool, and check its supply, and its motor for a short circuit or a blocked
    wheel; then switch the robot off and on
FAIL impossible_speeds
    the board reports impossible speeds ({cause})
    -> check the encoder of this wheel, its leads, and the counts per turn in the firmware; if the
    wheel really turns so fast, raise feedback.wheel_speed. Then type `acsard call clear`
FAIL wheel_reversed
    {wheel} wheel does not obey its command: it turns the wrong way {figures}:
    -> check the leads of its motor, the wires A and B of its encoder (an encoder with one channel
    has no direction), and the wheel's sign in mcu.wheels
FAIL wheel_runaway
    {wheel} wheel does not obey its command: it rolls on, or too far {figures}:
    -> check the motor driver, the encoder, and whether the firmware keeps the last speed of a wheel
    that stops
FAIL wheel_too_fast
    {wheel} wheel turns faster than the limiter allows {figures}:
    -> check the speed controller of the board
FAIL wheels_swapped
    {wheels} wheels do not obey their commands: each turns as the other one is commanded {figures}:
    -> check whether their motors or encoders are swapped, or reversed
FAIL no_wheel_moves
    all wheels turned, and for {seconds:g} s none has shown any motion {figures}:
    -> is the robot blocked, have the encoders or the motors lost their supply, or does the board
    report no speeds any more?
FAIL no_wheel_begins
    no wheel has begun to move for {seconds:.1f} s {figures}:
    -> is the robot blocked, have the motors or the encoders no supply, or is the speed too small
    for the motors?
WARN wheel_blocked
    {wheel} wheel is blocked, or has no power:
    -> check cable, motor and encoder, and for the last motor of a line also the setting
    mcu.trailing_comma
WARN wheel_slow
    {wheel} wheel reaches {share} of its expected speed:
    -> check the load, the battery, limits.wheel_speed and feedback.response_time
WARN wheel_fast
    {wheel} wheel reaches {share} of its expected speed:
    -> check the speed controller of the board and feedback.response_time
OK wheels_obey
    every wheel obeys its command
WARN wheel_fault | wheel fault
    {fault}
    -> {check}
WARN no_encoders
    {fault}
    -> if the robot has encoders, set feedback.encoders = true
"""
    + "".join(
        f"""
FAIL {code}
    the daemon's guard replaced a line for the board with zeros: the line {defect}
    -> this is a defect of acsard: report it with the newest recording (`acsard recording` lists the
    recordings), then look at the robot, and type `acsard call clear`
"""
        for code, defect in GUARD_DEFECTS.items()
    ),
)
