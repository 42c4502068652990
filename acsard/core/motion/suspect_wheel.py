"""Decides whether a suspect wheel has a faulty encoder, by its command or a gyro.

A faulty encoder shows one of three signs. It is dead (reports no turn), reversed (reports the
opposite of the other wheel) or stuck (repeats one speed). A wheel with such a sign is faulty if it
is further than the other wheel from an independent reference. That is the turn by a gyro, or else
the command: a healthy wheel is between its command and the speed that a slow wheel would have
reached by now. Without a reference nothing is decided: a person who pushes the robot may turn one
wheel and not the other.

`Suspect` judges a wheel that contradicts the other one of its side. `Stuck` watches every wheel,
because a stuck encoder agrees with the other wheel until the command changes.
"""

from __future__ import annotations

import math
from typing import Literal

from acsard.core.motion.wheel_witness import Expected

FAULT_S, FAULT_LINES = 0.025, 2
"""Seconds and lines for which the sign must last: three lines at 100 Hz, so one bad reading is not
enough."""

FAULT_COUNTS, FAULT_ANGLE = 3.5, 0.05
"""Counts and rad by which the other wheel must have turned further meanwhile."""

FOLLOWED_COUNTS, FOLLOWED_ANGLE = 2.5, 0.01
"""Counts and rad after which even a slow wheel has left its speed. A sound wheel cannot have
repeated one speed by then. If the other wheel has followed the command, this one is stuck."""

LEAVES = 0.05
"""rad/s by which a command must differ from that at the first repetition."""

VOTE = 1 / 3
"""Share of the difference between the two wheels by which this one must be further off."""

HAND_S = 0.3
"""Seconds of one repeated speed without a command that no hand can produce."""

DEAD, REVERSED = 0.1, 0.3
"""Shares of the other wheel's turn: below the first a wheel is dead, and this close to the opposite
it is reversed."""

STUCK = 0.3
"""Least difference for a stuck wheel, as a share of the faster wheel's turn. A smaller one is slip
next to a wheel at a steady speed."""

WheelFault = Literal["dead", "reversed", "stuck"]

WORDS: dict[WheelFault, str] = {
    "dead": "reports that it stands while the other wheel of its side turns",
    "reversed": "reports the opposite direction of the other wheel of its side",
    "stuck": "says one and the same speed",
}


class _Ballot:
    """The turns of both wheels, and the range of a true turn by one reference, rad."""

    def __init__(self) -> None:
        self._own = self._other = self._low = self._high = 0.0

    def add(self, own: float, other: float, low: float, high: float) -> None:
        """Add one line."""
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
        """The suspect's part of the error, from 1 (all of it) to -1 (all is the other wheel's)."""
        return (self._off(self._own) - self._off(self._other)) / (self.apart or 1.0)

    @property
    def share(self) -> float:
        """The difference as a share of the faster wheel's turn."""
        return self.apart / (max(abs(self._own), abs(self._other)) or 1.0)

    def _off(self, turned: float) -> float:
        return max(self._low - turned, turned - self._high, 0.0)


class Suspect:
    """The test of one wheel that shows the sign of a fault, line by line."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Start over: the wheel shows no sign."""
        self.sign: WheelFault | None = None
        self._lines = 0
        self._seconds = self._apart = 0.0
        self._command, self._gyro = _Ballot(), _Ballot()
        self._begun: float | None = None
        """Angle that the wheel turned in the first line, rad."""
        self._known = False
        """Whether the command was a reference in any line."""

    def looks(self, own: float, other: float, same: bool, dt: float, count: float) -> bool:
        """Return whether the wheel shows a sign of a fault, after a line of `dt` s.

        `own` and `other` are the angles by which this wheel and its partner turned in the line, and
        `count` is the angle of an encoder count, rad.
        `same` means that the wheel repeats the speed of the line before.
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
        """Return the sign.

        An earlier sign is kept where all signs look alike: through zero and at rest.
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
        """Add the references for this line; `gyro` is the true turn by a gyro, rad, or None."""
        slow, command = expected.speed, expected.commanded
        self._begun = abs(own) if self._begun is None else self._begun
        # The sound wheels of a slow robot still turn against a command that has changed its sign,
        # but they slow down.
        obeys = not expected.settled and own * command < 0.0 and abs(own) <= self._begun + count
        if expected.clear and not obeys:
            self._command.add(own, other, min(slow, command) * dt, max(slow, command) * dt)
            self._known = True
        if gyro is not None:
            self._gyro.add(own, other, gyro, gyro)

    def is_faulty(self, count: float) -> bool:
        """Return whether this wheel is faulty, and not the other wheel of its side.

        `count` is the angle between two encoder counts, rad.
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
        """Return whether a tyre cannot explain the difference to a wheel at a steady speed."""
        return self.sign != "stuck" or ballot.share >= STUCK


class Stuck:
    """The test of one wheel for a speed that stays although command and other wheel change.

    At a steady speed a stuck encoder reports the same as a sound one. Nothing can detect it then,
    and it does not harm the pose. When the command changes, a sound wheel must report another
    speed, even a slow wheel once it has gone a few counts further than the old speed would take
    it. If the other wheel of the side has followed the command, the command itself was obeyed.
    """

    def __init__(self) -> None:
        self._begin(0.0, math.nan)

    def _begin(self, slow: float, command: float) -> None:
        self._slow, self._command = slow, command
        self._seconds = self._followed = self._other = 0.0

    def left_by(self, command: float) -> bool:
        """Return whether the command, rad/s, differs from that at the first repetition."""
        return abs(command - self._command) >= LEAVES

    def says(self, same: bool, apart: float, dt: float, count: float, expected: Expected) -> bool:
        """Return whether the encoder is stuck, after a line of `dt` s.

        Args:
            same: Whether the wheel turns and repeats the speed of the line before.
            apart: Angle that the other wheel turned more in the line, rad.
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
    """Return whether a wheel that turned `own` rad stands, or nearly, beside the `other`."""
    return own == 0.0 or abs(own) <= DEAD * abs(other)


def reverses(own: float, other: float, count: float) -> bool:
    """Return whether a wheel reports the opposite of the other one, apart from encoder counts."""
    return own * other < 0.0 and abs(own + other) <= REVERSED * abs(other) + FAULT_COUNTS * count


def was_faulty(fault: WheelFault, own: float, other: float, now: float) -> bool:
    """Return whether an earlier line with these speeds may belong to the same fault.

    `now` is the present speed.
    """
    if fault == "reversed":
        return own * other <= 0.0
    return stands(own, other) if fault == "dead" else own == now
