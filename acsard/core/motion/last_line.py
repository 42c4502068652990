"""The line that `drive` made last, which may not have left, and why the next one is due."""

from __future__ import annotations

from msgspec import Struct

from acsard.core.motion.modes import Mode
from acsard.core.values import AT_REST, STILL, Motion, Ns, Trip, Twist, WheelSpeeds


class LastLine(Struct):
    motion: Motion = AT_REST
    speeds: WheelSpeeds = STILL  # zero after a press and without a link
    made_ns: Ns = 0
    # The twist to follow and the mode of the last line. None after a press: a new line is due.
    made_of: tuple[Twist | None, Mode] | None = None
    waits: bool = False  # for `sent`
    trip: Trip = ""  # why the guard replaced the last line, until the robot has latched the fault
    pressed_ns: Ns = 0  # last press of the emergency stop or a bumper
