"""Holds wheels against their commands, and decides when a wheel is a fault.

`Expected` is the one model of a healthy wheel: a first-order lag behind the command of its side.
`wheel_faults.py` asks it which of two wheels is wrong, and `Witness` asks it whether a wheel obeys.
The bounds around it leave room for load, slip and coarse encoders. Only behaviour that no healthy
wheel shows is evidence, and evidence must last.

A wheel that stands, turns against its command or turns too fast obeys as long as its speed nears
the command. A wheel that turns the right way and too slowly is a warning with its ratio: its load,
its battery or `feedback.response_time` may be the cause.
"""

from __future__ import annotations

import math
from typing import Literal

SLACK = 2.0
"""rad/s. Below this, coarse encoders and a robot at rest look like any fault."""

COMMANDED = 0.3
"""rad/s. A slower command shows little about which wheel is right."""

SLOWEST = 3.0
"""Response times after which even the wheels of a slow robot follow their command."""

CLEAR = 1.0
"""rad/s. A speed is the mean over the time in which one encoder count is this speed."""

NEARER = 1.0
"""rad/s by which a wheel that contradicts its command must near it to count as obeying."""

RATIO_S = 2.0
"""Seconds of driving over which a wheel's way is compared with the expected one."""

TOO_SLOW, FAST_ENOUGH = 0.7, 0.8
"""Ratios below which a wheel is too slow, and above which it no longer is."""

FaultKind = Literal["dead", "reversed", "runaway", "stuck"]

FAULTS: dict[FaultKind, str] = {
    "dead": "does not turn, or its encoder is dead: check cable, motor and encoder, and for "
    "motor d also mcu.trailing_comma",
    "reversed": "turns against its command: check the motor's leads, the A and B lines of its "
    "encoder, and its sign in mcu.wheels",
    "runaway": "turns faster than commanded: the motor driver or its encoder is at fault",
    "stuck": "reports one and the same speed: its encoder is stuck",
}


class Expected:
    """The speed that healthy wheels of one side have by their command, rad/s."""

    def __init__(self) -> None:
        self.commanded = self.speed = self._slow = 0.0
        self._begins = self.settled = self.clear = False

    def forget(self) -> None:
        """Start over at the speed of the next line: the wheels may still coast."""
        self.commanded, self._begins, self.clear = 0.0, True, False

    def follow(self, commanded: float, front: float, rear: float, dt: float, lag: float) -> None:
        """Take the command and the reported speeds of a line, rad/s, after `dt` s.

        `lag` is the response time of a healthy wheel, s.
        """
        if self._begins:
            self._begins = False
            self.speed = self._slow = front if abs(front) > abs(rear) else rear
        speed = self.speed = self.speed + (commanded - self.speed) * dt / (lag + dt)
        slow = self._slow = self._slow + (commanded - self._slow) * dt / (SLOWEST * lag + dt)
        self.commanded = commanded
        follows = speed * commanded > 0.0
        self.clear = follows and min(abs(speed), abs(commanded)) >= COMMANDED
        """Whether a wheel turns clearly in the direction of the command by now."""
        self.settled = follows and slow * commanded > 0.0
        """Whether even a slow wheel turns in this direction."""


class Witness:
    """The evidence against one wheel by its command, and the ratio of the two speeds."""

    def __init__(self) -> None:
        self.driven = False
        """Whether the wheel turned on command and has not come to rest since the command ended."""
        self.ratio = 1.0
        """Angle that the wheel turned the right way, as a share of the expected one, in the last
        `RATIO_S` s of driving."""
        self.slow = False
        """Whether the wheel turns the right way, but too slowly."""
        self.forget()

    def forget(self) -> None:
        """Start over. A wheel that has not come to rest yet still must."""
        self.speed = 0.0
        """Measured speed, smoothed, rad/s."""
        self._seen, self._begins = 0.0, True
        self.evidence: dict[FaultKind, float] = dict.fromkeys(FAULTS, 0.0)
        """Seconds for which the wheel has shown each fault."""
        self._suspected = False
        # Infinity lets the first line count as nearing. With 0, a wheel that was already too fast
        # would never count as slowing down: slow motors latched "runaway" that way.
        self._nearest = math.inf
        """Speed away from the command when the wheel last neared it, rad/s."""
        self._wrong = False
        """Whether the wheel was too fast, stood, or turned against its command in the last line."""
        self._seconds = self._went = self._way = 0.0

    def look(
        self, seen: float, expected: Expected, dt: float, most: float, count: float, still: bool
    ) -> bool:
        """Take a line that reports `seen` rad/s; return whether there is evidence.

        The line is at most `most` s of evidence. `count` is the angle of an encoder count, rad.
        `still` means that all wheels should stand.
        """
        goal, command = expected.speed, expected.commanded
        if self._begins:
            self._begins, self.speed = False, seen
        speed = self.speed = self.speed + (seen - self.speed) * dt / (count / CLEAR + dt)
        constant, self._seen = seen == self._seen, seen
        size, wish, turns = abs(goal), abs(command), abs(speed)
        driven = self.driven = not still or (self.driven and turns > SLACK)
        fastest, least = (size, wish) if size > wish else (wish, size)
        moving = size > SLACK and expected.settled
        fast = driven and turns > 1.5 * fastest + SLACK
        against = moving and speed * goal < 0.0 and turns > 0.3 * size
        # A wheel that slows down to its command sooner than `response_time` says is not dead.
        dead = moving and least > SLACK and abs(seen) < 0.1 * least
        wrong = fast or against or dead
        off = turns if fast else -math.copysign(1.0, command) * speed
        nearing = off < self._nearest - NEARER
        if nearing or not wrong:
            self._nearest = off
        elif not self._wrong:
            self._nearest = max(self._nearest, off)
        self._wrong = wrong
        if moving and not wrong:
            self._compare(turns, size, dt)
        stuck = constant and driven and seen != 0.0
        if stuck:
            stuck = min(abs(seen - goal), abs(seen - command)) > SLACK + 0.4 * fastest
        wrong = wrong and not nearing
        bad = wrong or stuck
        if bad or self._suspected:
            self._suspected = bad
            signs = dead and wrong, against and wrong, fast and wrong, stuck
            for kind, sign in zip(FAULTS, signs, strict=True):
                self.evidence[kind] = self.evidence[kind] + min(dt, most) if sign else 0.0
        return bad

    def _compare(self, turns: float, size: float, dt: float) -> None:
        self._seconds += dt
        self._went += turns * dt
        self._way += size * dt
        if self._seconds >= RATIO_S:
            self.ratio = self._went / self._way
            self.slow = self.ratio < (FAST_ENOUGH if self.slow else TOO_SLOW)
            self._seconds = self._went = self._way = 0.0
