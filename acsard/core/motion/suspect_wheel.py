"""Decides whether a suspect wheel has a faulty encoder, by comparison with its command or a gyro.

A faulty encoder is dead (reports no turn), reversed (the opposite of the other wheel) or stuck (one
speed). With such a sign a wheel is faulty if a reference differs more from it than from the other
wheel of its side: the turn by a gyro or, without one, the command. Without both only a stuck wheel
is found, because a push may turn one wheel and not the other. `Suspect` tests a wheel that
contradicts the other one, `Stuck` every wheel, because a stuck encoder agrees until the command
changes.
"""

from __future__ import annotations

import math
from typing import Literal

from acsard.core.motion.wheel_witness import Expected
from acsard.core.values import Rad

# Least duration of a sign: three lines at 100 Hz, so one bad reading is not enough.
FAULT_S, FAULT_LINES = 0.025, 2

FAULT_COUNTS, FAULT_ANGLE = 3.5, 0.05  # counts plus rad by which the wheels of the side must differ

# Counts plus rad by which a healthy wheel must have left the old speed after a new command.
FOLLOWED_COUNTS, FOLLOWED_ANGLE = 2.5, 0.01

MIN_COMMAND_CHANGE = 0.05  # rad/s, after which a healthy wheel must report a different speed

# Fraction of the wheels' difference by which a reference must be nearer to one of them.
MIN_DISTANCE_FRACTION = 1 / 3

STUCK_TIME_S = 0.3  # without a command or a gyro: no person turns a wheel so evenly

# Of the other wheel's angle: at most the first is dead, the opposite within the second reversed.
DEAD_FRACTION, REVERSED_FRACTION = 0.1, 0.3

# Of the larger angle, by which a side must differ: the even wheel may be right, and the other slip.
MIN_STUCK_FRACTION = 0.3

WheelFault = Literal["dead", "reversed", "stuck"]

FAULT_TEXTS: dict[WheelFault, str] = {
    "dead": "reports no motion while the other wheel on its side turns",
    "reversed": "reports a direction opposite to that of the other wheel on its side",
    "stuck": "reports a speed that never changes",
}


class _Ballot:
    # Angles, rad, that decide which wheel is wrong. `low` and `high` limit a healthy one's.
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
        self.sign: WheelFault | None = None
        self._lines = 0
        self._seconds = self._apart = 0.0
        self._command, self._gyro = _Ballot(), _Ballot()
        self._begun: float | None = None  # rad rolled in the first line
        self._known = False  # a line was compared with the command

    def looks(self, own: float, other: float, same: bool, dt: float, count: float) -> bool:
        """Add a line, and return whether the wheel now shows a sign of a faulty encoder.

        `own` and `other` are rolled angles of the side, rad, `same` says that the speed is the
        previous one, and `count` is the angle of an encoder count, rad.
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
        """Compare the side with the command and the gyro; see `looks`.

        `gyro` is the angle that this side rolled by a trusted gyro, rad.
        """
        # A healthy speed lies between the command and that of a wheel with `response_time`.
        slow, command = expected.speed, expected.commanded
        self._begun = abs(own) if self._begun is None else self._begun
        # A healthy wheel of a slow robot turns against a reversed command for a while, but not
        # faster than in the first line of the test.
        obeys = not expected.settled and own * command < 0.0 and abs(own) <= self._begun + count
        if expected.clear and not obeys:
            self._command.add(own, other, min(slow, command) * dt, max(slow, command) * dt)
            self._known = True
        if gyro is not None:
            self._gyro.add(own, other, gyro, gyro)

    def is_faulty(self, count: float) -> bool:
        """Return whether this wheel is shown to be faulty and the other one is not."""
        enough = FAULT_COUNTS * count + FAULT_ANGLE
        if self._lines < FAULT_LINES or self._seconds < FAULT_S or abs(self._apart) < enough:
            return False
        if self._gyro.apart >= enough and abs(self._gyro.vote) >= MIN_DISTANCE_FRACTION:
            return self._gyro.vote > 0.0 and self._plain(self._gyro)
        if self._command.apart >= enough:
            return self._command.vote >= MIN_DISTANCE_FRACTION and self._plain(self._command)
        return self.sign == "stuck" and not self._known and self._seconds >= STUCK_TIME_S

    def _plain(self, ballot: _Ballot) -> bool:
        # Only a faulty encoder explains the sign: a stuck wheel may be right while the other slips.
        return self.sign != "stuck" or ballot.share >= MIN_STUCK_FRACTION


class Stuck:
    """The test of one wheel for an encoder that repeats one speed although the command has changed.

    After a new command, a healthy wheel must report another speed once its angle differs by a few
    counts. If only the other wheel does, this encoder is stuck. At a constant speed no test can
    show it, but it does no harm either.
    """

    def __init__(self) -> None:
        self._begin(0.0, math.nan)

    def _begin(self, slow: float, command: float) -> None:
        self._slow, self._command = slow, command
        self._seconds = self._followed = self._other = 0.0

    def command_changed(self, command: float) -> bool:
        return abs(command - self._command) >= MIN_COMMAND_CHANGE

    def add(self, same: bool, apart: float, dt: float, count: float, expected: Expected) -> bool:
        """Add a line, and return whether the encoder of this wheel is stuck.

        `same` says that the wheel turns and repeats its speed, and `apart` is how much further the
        other wheel of the side turned, rad.
        """
        slow, command = expected.speed, expected.commanded
        leaves = command - self._command
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
    """Return whether a wheel that turned `own` seems to stand still beside one of `other`."""
    return own == 0.0 or abs(own) <= DEAD_FRACTION * abs(other)


def reverses(own: Rad, other: Rad, count: Rad) -> bool:
    """Return whether a wheel turned about as far as the other one, but backward."""
    return (
        own * other < 0.0
        and abs(own + other) <= REVERSED_FRACTION * abs(other) + FAULT_COUNTS * count
    )


def was_faulty(fault: WheelFault, own: float, other: float, now: float) -> bool:
    """Return whether the fault may already have been present in an earlier line.

    `own` and `other` are speeds in that line, `now` the faulty wheel's present one, rad/s.
    """
    if fault == "reversed":
        return own * other <= 0.0
    return seems_still(own, other) if fault == "dead" else own == now
