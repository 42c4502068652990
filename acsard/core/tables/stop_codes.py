"""The codes of stops: who or what stopped the robot, and what keeps it from driving."""

from __future__ import annotations

from typing import Literal

from acsard.core.tables.finding_table import table

# Causes of a latched stop.
StopCode = Literal[
    "stopped", "stopped_by_others", "stopped_at_start", "emergency_stop", "emergency_stop_silent",
    "bumper", "bumpers_silent", "battery_empty",
]  # fmt: skip

RestCode = Literal[
    StopCode, "switched_off", "other_version", "shutting_down", "emergency_stop_missing",
    "bumpers_missing", "bumper_away", "bumper_blocks",
]  # fmt: skip

# Of the inputs and the battery in `diagnostics`.
InputCode = Literal[
    "no_emergency_stop", "emergency_stop_released", "bumpers_released", "battery_ok", "battery_low",
    "battery_unknown", "battery_missing", "speed_limited",
]  # fmt: skip

STOPS = table(
    Literal[RestCode, InputCode],
    """
OK shutting_down
    the daemon is shutting down
OK switched_off
    switched off by {by}
    -> type `acsard call activate`
WARN other_version
    {cause} ({named})
    -> another version of acsard stopped the robot: look at the robot, and type `acsard call clear`
WARN stopped
    stopped by {by}
    -> look at the robot, and type `acsard call clear`
WARN stopped_by_others
    stopped by {by} and maybe by others, because more clients stopped the robot than it lists
    -> look at the robot, and type `acsard call clear`
WARN stopped_at_start
    stopped when the daemon started, because {cause}
    -> look at the robot, and type `acsard call clear`
WARN emergency_stop | emergency stop pressed
    emergency stop pressed at the robot
    -> release it at the robot
FAIL emergency_stop_silent | emergency stop not reported
    the board has not reported its emergency stop for {seconds:g} s, so it counts as pressed
    -> check the board and its cable
FAIL emergency_stop_missing
    safety.estop = "required", but the microcontroller has not reported an emergency-stop input:
    -> does its firmware send status lines with `estop=`?
WARN bumper | bumper pressed
    {bumpers}
    -> release it at the robot
FAIL bumpers_silent
    the board has not reported its bumpers for {seconds:g} s, so they count as pressed
    -> check the board and its cable
FAIL bumpers_missing
    safety.bumpers has {places}, but the microcontroller has not reported {bumpers}:
    -> does its firmware send status lines with `bumpers={dots}`?
WARN bumper_away
    {bumpers}:
    -> the robot drives only straight {direction}, at most {speed:g} m/s
WARN bumper_blocks
    {bumpers}:
    -> no straight motion leads away from the pressed bumpers, so the robot stands still until the
    bumpers are released
FAIL battery_empty | battery empty
    battery below {threshold}
    -> charge the battery to {charged}
OK no_emergency_stop
    no emergency-stop input
OK emergency_stop_released
    emergency stop released
OK bumpers_released
    {bumpers} released
OK battery_ok
    {text}
WARN battery_low | battery low
    {text}
    -> charge the battery
WARN battery_unknown | battery level unknown
    {text}
    -> {check}
WARN battery_missing
    {text}
    -> {check}
OK speed_limited
    speed limit: {limit}
""",
)
