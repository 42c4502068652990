"""The motion in the lines for the board. A line that did not leave has no effect on it."""

from __future__ import annotations

from msgspec import Struct

from acsard.core.motion.limits import AT_REST, Motion
from acsard.core.motion.modes import Mode
from acsard.core.values import REST, STILL, Ns, Trip, Twist, WheelSpeeds


class LastLine(Struct):
    """The last line that left, and the one that waits for `sent`."""

    motion: Motion = AT_REST  # of the last line that left
    # Its wheel speeds. After a press of the emergency stop, the wheels turn so until the zeros are
    # written.
    written: WheelSpeeds = STILL
    left_ns: Ns = 0
    speeds: WheelSpeeds = STILL  # of the last line; zero after a press and without a link
    applied: Twist = REST  # after `sent`, in the last line that left
    made_ns: Ns = 0  # the last line was made
    # The twist to follow and the mode of the last line. None after a press: a new line is due.
    made_of: tuple[Twist | None, Mode] | None = None
    waiting: tuple[Motion, WheelSpeeds] | None = None  # for `sent`
    trip: Trip = ""  # why the guard replaced the last line, until the robot has latched the fault
    pressed_ns: Ns = 0  # last press of the emergency stop or a bumper

    def cut(self) -> None:
        """Set the speed to zero without a ramp: the motors have stopped."""
        self.motion, self.speeds, self.applied = AT_REST, STILL, REST

    def press(self, now_ns: Ns) -> None:
        """Cut, until a line of zeros has left."""
        self.cut()
        self.made_of, self.pressed_ns = None, now_ns

    def sent(self, left: bool, trip: Trip) -> None:
        """Record whether the line left, and why the guard replaced it with zeros."""
        waiting, self.waiting, self.trip = self.waiting, None, trip
        assert waiting is not None
        if left:
            self.left_ns = self.made_ns
            self.motion, self.written = (AT_REST, STILL) if trip else waiting
        elif trip:
            self.motion = AT_REST
        self.applied = self.motion.twist
