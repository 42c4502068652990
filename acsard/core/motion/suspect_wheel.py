"""Decides whether a suspect wheel has a faulty encoder, by comparison with its command or a gyro.

A faulty encoder shows one of three signs. It is dead (reports no turn), reversed (reports the
opposite of the other wheel) or stuck (repeats one speed). A wheel with such a sign is faulty if an
independent reference differs more from it than from the other wheel of its side. The reference is
the turn according to a gyro or, without one, the command: the speed of a healthy wheel lies between
its command and the speed that a slow wheel would have reached by now. Without a reference nothing
is decided: a person who pushes the robot may turn one wheel and not the other.

`Suspect` tests a wheel that contradicts the other one of its side. `Stuck` tests every wheel,
because a stuck encoder agrees with the other wheel until the command changes.
"""

from __future__ import annotations

import math
from typing import Literal

from acsard.core.motion.wheel_witness import Expected

FAULT_S, FAULT_LINES = 0.025, 2
"""Time, s, and number of lines for which the sign must last: three lines at 100 Hz, so one bad
reading is not enough."""

FAULT_COUNTS, FAULT_ANGLE = 3.5, 0.05
"""The two terms, encoder counts and rad, of the angle by which the other wheel must have turned
further than the suspect wheel while the sign lasted."""

FOLLOWED_COUNTS, FOLLOWED_ANGLE = 2.5, 0.01
"""The two terms of an angle, encoder counts and rad. When even a slow wheel must have turned by
this angle more or less than at its old speed, a sound wheel can no longer repeat that speed. If the
other wheel has followed the command, this one is stuck."""

LEAVES = 0.05
"""Least difference, rad/s, of the command from the command at the first repetition of a speed."""

VOTE = 1 / 3
"""A reference decides only if one wheel is further from it than the other wheel by at least this
share of the difference between the two wheels."""

HAND_S = 0.3
"""Time for which a wheel must repeat one speed without a command before it is called stuck, s. A
hand cannot turn a wheel as evenly as this."""

DEAD, REVERSED = 0.1, 0.3
"""Shares of the other wheel's turn. A wheel that turns by less than the first share is dead. A
wheel whose turn differs from the opposite of that turn by less than the second share is reversed.
"""

STUCK = 0.3
"""Least difference between the two wheels for calling one stuck, as a share of the faster wheel's
turn. A smaller difference may be slip of the other wheel while this one turns steadily."""

WheelFault = Literal["dead", "reversed", "stuck"]

WORDS: dict[WheelFault, str] = {
    "dead": "reports that it stands while the other wheel of its side turns",
    "reversed": "reports the opposite direction of the other wheel of its side",
    "stuck": "says one and the same speed",
}


class _Ballot:
    """Sums of the two wheels' turns, and of the range of the true turn by one reference, rad."""

    def __init__(self) -> None:
        self._own = self._other = self._low = self._high = 0.0

    def add(self, own: float, other: float, low: float, high: float) -> None:
        """Add one line.

        `own` and `other` are the turns of the suspect wheel and the other one, and `low` and `high`
        are the range of the true turn, all in rad.
        """
        self._own += own
        self._other += other
        self._low += low
        self._high += high

    @property
    def apart(self) -> float:
        """Difference between the two wheels, rad."""
        return abs(self._own - self._other)

    @property
    def vote(self) -> float:
        """Which wheel is wrong: from 1 (only the suspect wheel) to -1 (only the other wheel)."""
        return (self._off(self._own) - self._off(self._other)) / (self.apart or 1.0)

    @property
    def share(self) -> float:
        """The difference as a share of the faster wheel's turn."""
        return self.apart / (max(abs(self._own), abs(self._other)) or 1.0)

    def _off(self, turned: float) -> float:
        return max(self._low - turned, turned - self._high, 0.0)


class Suspect:
    """The test, line by line, of one wheel that contradicts the other one of its side."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Start over, without a sign."""
        self.sign: WheelFault | None = None
        self._lines = 0
        self._seconds = self._apart = 0.0
        self._command, self._gyro = _Ballot(), _Ballot()
        self._begun: float | None = None
        """Size of the angle that the wheel turned in the first line of the test, rad; None before
        it."""
        self._known = False
        """Whether the command was a reference in any line of the test."""

    def looks(self, own: float, other: float, same: bool, dt: float, count: float) -> bool:
        """Add a line, and return whether the wheel shows a sign of a fault.

        Args:
            own: The angle by which this wheel turned in the line, rad.
            other: The angle by which the other wheel of its side turned, rad.
            same: Whether this wheel repeats the speed of the line before.
            dt: Duration of the line, s.
            count: Angle of an encoder count, rad.
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
        """Return the sign of a fault in this line, None without one.

        The previous sign stays while all signs look alike: at rest, and when the speed crosses
        zero.
        """
        if self.sign == "stuck" and same:
            return "stuck"
        if reverses(own, other, count) or (self.sign == "reversed" and own * other == 0.0):
            return "reversed"
        if stands(own, other):
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
        """Compare both wheels with the references in this line.

        Args:
            own: The angle by which this wheel turned in the line, rad.
            other: The angle by which the other wheel of its side turned, rad.
            dt: Duration of the line, s.
            count: Angle of an encoder count, rad.
            expected: The command, and the speed of a wheel that follows it slowly.
            gyro: The true angle of this side according to a gyro, rad, or None.
        """
        slow, command = expected.speed, expected.commanded
        self._begun = abs(own) if self._begun is None else self._begun
        # After a command to the other direction, a sound wheel of a slow robot still turns against
        # the command. It obeys if it does not turn faster than in the first line of the test.
        obeys = not expected.settled and own * command < 0.0 and abs(own) <= self._begun + count
        if expected.clear and not obeys:
            self._command.add(own, other, min(slow, command) * dt, max(slow, command) * dt)
            self._known = True
        if gyro is not None:
            self._gyro.add(own, other, gyro, gyro)

    def is_faulty(self, count: float) -> bool:
        """Return whether this wheel is faulty, rather than the other wheel of its side.

        `count` is the angle of an encoder count, rad.
        """
        enough = FAULT_COUNTS * count + FAULT_ANGLE
        if self._lines < FAULT_LINES or self._seconds < FAULT_S or abs(self._apart) < enough:
            return False
        if self._gyro.apart >= enough and abs(self._gyro.vote) >= VOTE:
            return self._gyro.vote > 0.0 and self._plain(self._gyro)
        if self._command.apart >= enough:
            return self._command.vote >= VOTE and self._plain(self._command)
        return self.sign == "stuck" and not self._known and self._seconds >= HAND_S

    def _plain(self, ballot: _Ballot) -> bool:
        """Return whether slip of the other wheel cannot explain the difference."""
        return self.sign != "stuck" or ballot.share >= STUCK


class Stuck:
    """The test of one wheel for a speed that stays the same although it must change.

    At a steady speed a stuck encoder reports the same as a sound one. Nothing can detect it then,
    and it does not harm the pose. When the command changes, a sound wheel must report another
    speed. Even a slow wheel must do so as soon as its angle differs by a few counts from the angle
    at the old speed. If the other wheel of the side has followed the new command, the motors obeyed
    it, so this encoder is stuck.
    """

    def __init__(self) -> None:
        self._begin(0.0, math.nan)

    def _begin(self, slow: float, command: float) -> None:
        self._slow, self._command = slow, command
        self._seconds = self._followed = self._other = 0.0

    def left_by(self, command: float) -> bool:
        """Return whether `command`, rad/s, differs from the one at the first repetition."""
        return abs(command - self._command) >= LEAVES

    def says(self, same: bool, apart: float, dt: float, count: float, expected: Expected) -> bool:
        """Return whether the encoder is stuck, after a line of `dt` s.

        Args:
            same: Whether the wheel turns and repeats the speed of the line before.
            apart: Angle by which the other wheel turned further in the line, rad.
            dt: Duration of the line, s.
            count: Angle of an encoder count, rad.
            expected: The command, and the speed of a wheel that follows it slowly.
        """
        slow, command = expected.speed, expected.commanded
        leaves = command - self._command
        if not (same and abs(leaves) >= LEAVES):  # this also holds for the first line
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


def stands(own: float, other: float) -> bool:
    """Return whether a wheel that turned `own` rad stands, if the other one turned `other` rad."""
    return own == 0.0 or abs(own) <= DEAD * abs(other)


def reverses(own: float, other: float, count: float) -> bool:
    """Return whether a wheel that turned `own` rad reports about the opposite of the other one.

    `other` is the turn of the other wheel, and `count` the angle of an encoder count, both in rad.
    """
    return own * other < 0.0 and abs(own + other) <= REVERSED * abs(other) + FAULT_COUNTS * count


def was_faulty(fault: WheelFault, own: float, other: float, now: float) -> bool:
    """Return whether the fault may already have been present in an earlier line.

    `own` and `other` are the speeds of the faulty wheel and of the other one in that line, rad/s.
    `now` is the present speed of the faulty wheel, rad/s.
    """
    if fault == "reversed":
        return own * other <= 0.0
    return stands(own, other) if fault == "dead" else own == now
