"""Decides whether a suspect wheel has a faulty encoder, by comparison with its command or a gyro.

A faulty encoder shows one of three signs. It is dead (reports no turn), reversed (reports the
opposite of the other wheel) or stuck (repeats one speed). A wheel with such a sign is faulty if an
independent reference differs more from this wheel than from the other wheel of its side. The
reference is the turn according to a gyro or, without a gyro, the command. Without a reference, only
a stuck wheel is found, because a person who pushes the robot may turn one wheel and not the other.

`Suspect` tests a wheel that contradicts the other wheel of its side. `Stuck` tests every wheel,
because a stuck encoder agrees with the other wheel until the command changes.
"""

from __future__ import annotations

import math
from typing import Literal

from acsard.core.motion.wheel_witness import Expected

FAULT_S, FAULT_LINES = 0.025, 2
"""Shortest time, s (`FAULT_S`), and smallest number of feedback lines (`FAULT_LINES`) for which a
sign of a faulty encoder must last. At 100 Hz, `FAULT_S` takes three lines, so one bad reading is
not enough."""

FAULT_COUNTS, FAULT_ANGLE = 3.5, 0.05
"""A wheel can be called faulty only if the angles of the two wheels of its side differ by at least
`FAULT_COUNTS` encoder counts plus `FAULT_ANGLE` rad."""

FOLLOWED_COUNTS, FOLLOWED_ANGLE = 2.5, 0.01
"""After a new command, a wheel that repeats its old speed counts as stuck only if a healthy wheel
would have rolled a clearly different angle by now. The difference from the angle at the old speed
must be at least `FOLLOWED_COUNTS` encoder counts plus `FOLLOWED_ANGLE` rad."""

MIN_COMMAND_CHANGE = 0.05
"""Smallest change of the command, rad/s, after which a healthy wheel must report a different
speed."""

MIN_DISTANCE_FRACTION = 1 / 3
"""A reference (a gyro or the command) decides which of two wheels is faulty only if it is clearly
nearer to one wheel. Its distances from the two wheels must differ by at least this fraction of the
difference between the wheels."""

STUCK_TIME_S = 0.3
"""If neither a command nor a gyro shows which wheel is right, a wheel must repeat one speed for
this time before it is called stuck, s. A person cannot turn a wheel so evenly by hand."""

DEAD_FRACTION, REVERSED_FRACTION = 0.1, 0.3
"""Fractions of the angle that the other wheel of the side rolled. A wheel is dead if its angle is
at most the fraction `DEAD_FRACTION`. It is reversed if it rolled in the opposite direction, and if
the magnitudes of the two angles differ by at most the fraction `REVERSED_FRACTION`."""

MIN_STUCK_FRACTION = 0.3
"""A wheel can be called stuck only if the angles of the two wheels of its side differ by at least
this fraction of the larger angle. Otherwise the wheel with the constant speed may be healthy while
the other wheel slips."""

WheelFault = Literal["dead", "reversed", "stuck"]

FAULT_TEXTS: dict[WheelFault, str] = {
    "dead": "reports no motion while the other wheel on its side turns",
    "reversed": "reports a direction opposite to that of the other wheel on its side",
    "stuck": "reports a speed that never changes",
}


class _Ballot:
    """Sums of angles over feedback lines, rad, to decide which of two wheels is wrong.

    `low` and `high` limit the angle of a healthy wheel according to the command or a gyro.
    """

    def __init__(self) -> None:
        self._own = self._other = self._low = self._high = 0.0

    def add(self, own: float, other: float, low: float, high: float) -> None:
        self._own += own
        self._other += other
        self._low += low
        self._high += high

    @property
    def apart(self) -> float:
        return abs(self._own - self._other)

    @property
    def vote(self) -> float:
        """Vote from 1 (only the suspect wheel is wrong) to -1 (only the other wheel is wrong)."""
        return (self._off(self._own) - self._off(self._other)) / (self.apart or 1.0)

    @property
    def share(self) -> float:
        return self.apart / (max(abs(self._own), abs(self._other)) or 1.0)

    def _off(self, turned: float) -> float:
        return max(self._low - turned, turned - self._high, 0.0)


class Suspect:
    """The test, over several lines, of a wheel that contradicts the other wheel of its side."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Start a new test, in which the wheel has shown no sign of a fault."""
        self.sign: WheelFault | None = None
        self._lines = 0
        self._seconds = self._apart = 0.0
        self._command, self._gyro = _Ballot(), _Ballot()
        self._begun: float | None = None
        """Magnitude of the angle that the wheel rolled in the first line of the test, rad."""
        self._known = False
        """Whether at least one line of the test was compared with the command."""

    def looks(self, own: float, other: float, same: bool, dt: float, count: float) -> bool:
        """Add a feedback line, and return whether the wheel now shows a sign of a faulty encoder.

        Args:
            own: the angle that this wheel rolled in the line, rad.
            other: the angle that the other wheel of its side rolled, rad.
            same: whether this wheel repeats the speed of the previous line.
            dt: the time that the line covers, s.
            count: the angle of an encoder count, rad.
        """
        sign = self._sign(own, other, same, count)
        if sign != self.sign:
            self.forget()
            self.sign = sign
        self._lines += 1
        self._seconds += dt
        self._apart += other - own
        return sign is not None

    def _sign(self, own: float, other: float, same: bool, count: float) -> WheelFault | None:
        if self.sign == "stuck" and same:
            return "stuck"
        if reverses(own, other, count) or (self.sign == "reversed" and own * other == 0.0):
            return "reversed"
        if seems_still(own, other):
            return "dead"
        return "stuck" if same else None

    def compare(
        self,
        own: float,
        other: float,
        dt: float,
        count: float,
        expected: Expected,
        gyro: float | None,
    ) -> None:
        """Compare both wheels of the side with the command and the gyro in a feedback line.

        Args:
            own: the angle that this wheel rolled in the line, rad.
            other: the angle that the other wheel of its side rolled, rad.
            dt: the time that the line covers, s.
            count: the angle of an encoder count, rad.
            expected: the speed of a healthy wheel.
            gyro: the angle that this side rolled according to a gyro, rad; None without a trusted
                gyro.
        """
        # The speed of a healthy wheel lies between its command and the speed that a wheel with
        # `feedback.response_time` has reached by now.
        slow, command = expected.speed, expected.commanded
        self._begun = abs(own) if self._begun is None else self._begun
        # After a command to the other direction, a healthy wheel of a slow robot turns against the
        # command for a while. Such a wheel obeys its command if it does not turn faster than in the
        # first line of the test.
        obeys = not expected.settled and own * command < 0.0 and abs(own) <= self._begun + count
        if expected.clear and not obeys:
            self._command.add(own, other, min(slow, command) * dt, max(slow, command) * dt)
            self._known = True
        if gyro is not None:
            self._gyro.add(own, other, gyro, gyro)

    def is_faulty(self, count: float) -> bool:
        """Return whether the lines so far show that this wheel is faulty and the other one is not.

        `count` is the angle of an encoder count, rad.
        """
        enough = FAULT_COUNTS * count + FAULT_ANGLE
        if self._lines < FAULT_LINES or self._seconds < FAULT_S or abs(self._apart) < enough:
            return False
        if self._gyro.apart >= enough and abs(self._gyro.vote) >= MIN_DISTANCE_FRACTION:
            return self._gyro.vote > 0.0 and self._plain(self._gyro)
        if self._command.apart >= enough:
            return self._command.vote >= MIN_DISTANCE_FRACTION and self._plain(self._command)
        return self.sign == "stuck" and not self._known and self._seconds >= STUCK_TIME_S

    def _plain(self, ballot: _Ballot) -> bool:
        """Return whether only a faulty encoder can explain the sign of this wheel.

        If the sign is "stuck", the wheel may also be healthy while the other wheel slips. Then the
        result is False, unless the two wheels differ by at least `MIN_STUCK_FRACTION`.
        """
        return self.sign != "stuck" or ballot.share >= MIN_STUCK_FRACTION


class Stuck:
    """The test of one wheel for an encoder that repeats one speed although the command has changed.

    After a new command, a healthy wheel must report another speed as soon as its expected angle
    differs by a few counts from the angle at the old speed. If only the other wheel of the side
    reports another speed, this encoder is stuck. While the robot drives at a constant speed, no
    test can detect a stuck encoder, but then it does not harm the pose either.
    """

    def __init__(self) -> None:
        self._begin(0.0, math.nan)

    def _begin(self, slow: float, command: float) -> None:
        self._slow, self._command = slow, command
        self._seconds = self._followed = self._other = 0.0

    def command_changed(self, command: float) -> bool:
        """Return whether the command has changed since the wheel began to repeat its speed.

        `command` is the present command for the wheel, rad/s. A change below `MIN_COMMAND_CHANGE`
        does not count.
        """
        return abs(command - self._command) >= MIN_COMMAND_CHANGE

    def add(self, same: bool, apart: float, dt: float, count: float, expected: Expected) -> bool:
        """Add a feedback line, and return whether the encoder of this wheel is stuck.

        Args:
            same: whether the wheel turns and repeats the speed of the previous line.
            apart: the angle by which the other wheel of the side turned further than this wheel,
                rad.
            dt: the time that the line covers, s.
            count: the angle of an encoder count, rad.
            expected: the speed of a healthy wheel.
        """
        slow, command = expected.speed, expected.commanded
        leaves = command - self._command
        # In the first line, the NaN makes this condition true.
        if not (same and abs(leaves) >= MIN_COMMAND_CHANGE):
            self._begin(slow, command)
            return False
        self._seconds += dt
        self._followed += (slow - self._slow) * dt
        self._other += apart
        followed = self._followed if leaves > 0.0 else -self._followed
        other = self._other if leaves > 0.0 else -self._other
        return (
            self._seconds >= FAULT_S
            and followed >= FOLLOWED_COUNTS * count + FOLLOWED_ANGLE
            and other >= FAULT_COUNTS * count + FAULT_ANGLE
        )


def seems_still(own: float, other: float) -> bool:
    """Return whether a wheel seems to stand still.

    The wheel turned `own` rad, and the other wheel of its side turned `other` rad.
    """
    return own == 0.0 or abs(own) <= DEAD_FRACTION * abs(other)


def reverses(own: float, other: float, count: float) -> bool:
    """Return whether a wheel turned about as far as the other one, but in the opposite direction.

    The wheel turned `own` rad, and the other wheel of its side turned `other` rad. `count` is the
    angle of an encoder count, rad.
    """
    return (
        own * other < 0.0
        and abs(own + other) <= REVERSED_FRACTION * abs(other) + FAULT_COUNTS * count
    )


def was_faulty(fault: WheelFault, own: float, other: float, now: float) -> bool:
    """Return whether the fault of a wheel may already have been present in an earlier line.

    `own` and `other` are the speeds of the faulty wheel and of the other wheel of its side in that
    line. `now` is the present speed of the faulty wheel. All are in rad/s.
    """
    if fault == "reversed":
        return own * other <= 0.0
    return seems_still(own, other) if fault == "dead" else own == now
