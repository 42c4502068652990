"""Compares wheels with their commands, and collects the evidence that a wheel is faulty.

`Expected` is the only model of a healthy wheel: its speed follows the command with a first-order
lag, within limits for load, slip and coarse encoders. Evidence is behavior that no healthy wheel
shows, and proves a fault only if it lasts. A wheel that stands still, turns backward or too fast is
none while it approaches the command. One that turns too slowly is a warning with the ratio: load,
battery or `feedback.response_time`.
"""

from __future__ import annotations

import math
from typing import Literal

from acsard.core.codes import FaultCode

MIN_FAULT_SPEED = 2.0  # rad/s; below it, coarse encoders can look like any fault

MIN_COMMANDED_SPEED = 0.3  # rad/s, at which the command can show which of two wheels is right

SLOW_RESPONSE_FACTOR = 3.0  # of `feedback.response_time`, in a slow robot

SMOOTHING_SPEED = 1.0  # rad/s: smoothed over the time of one count at it

MIN_APPROACH = 1.0  # rad/s closer to the command: no evidence of a fault

RATIO_DRIVE_S = 2.0  # of driving, over which the rolled angle is compared

# Ratios to the expected speed: too slow below the first, until the second.
TOO_SLOW, FAST_ENOUGH = 0.7, 0.8

FaultKind = Literal["dead", "reversed", "runaway", "stuck"]

WITNESS_CODES: dict[FaultKind, FaultCode] = {
    "dead": "wheel_dead",
    "reversed": "wheel_reversed",
    "runaway": "wheel_runaway",
    "stuck": "wheel_stuck",
}


def faster(front: float, rear: float) -> float:
    return front if abs(front) > abs(rear) else rear


class Expected:
    """The speed, rad/s, that the wheels of one side should have now if they are healthy."""

    def __init__(self) -> None:
        self.commanded = self.speed = self._slow = 0.0
        self._begins = self.settled = self.clear = False

    def forget(self) -> None:
        """Start over from the next reported speed, because the wheels may still be turning."""
        self.commanded, self._begins, self.clear = 0.0, True, False

    def slow_down(self, front: float, rear: float) -> None:
        """Limit the expected speed by two reported ones: the board may have stopped the motors."""
        most = faster(front, rear)
        self.speed, self._slow = (
            min(most, old, key=abs) if most * old > 0.0 else 0.0 for old in (self.speed, self._slow)
        )

    def follow(self, commanded: float, front: float, rear: float, dt: float, lag: float) -> None:
        """Update the expected speed with a line; `lag` is a healthy response time, s."""
        if self._begins:
            self._begins = False
            self.speed = self._slow = faster(front, rear)
        speed = self.speed = self.speed + (commanded - self.speed) * dt / (lag + dt)
        slow = self._slow = self._slow + (commanded - self._slow) * dt / (
            SLOW_RESPONSE_FACTOR * lag + dt
        )
        self.commanded = commanded
        follows = speed * commanded > 0.0
        self.clear = (
            follows and abs(speed) >= MIN_COMMANDED_SPEED and abs(commanded) >= MIN_COMMANDED_SPEED
        )
        self.settled = follows and slow * commanded > 0.0  # so must even that of a slow robot


class Witness:
    """The evidence that one wheel does not follow its command, or is slower than expected."""

    def __init__(self) -> None:
        self.driven = False  # from a command to any wheel until this one is at rest
        self.ratio = 1.0  # of the last `RATIO_DRIVE_S`: rolled over expected
        self.slow = False  # turns as commanded, but too slowly
        # Expected magnitude of `speed`, smoothed like it, or a healthy wheel seems to brake late.
        self._due = 0.0
        self._rested_s = 0.0  # since a speed above `MIN_FAULT_SPEED`
        self.forget()

    def forget(self) -> None:
        """Drop the evidence of faults; `driven`, `ratio` and `slow` stay valid."""
        self.speed = 0.0  # smoothed, rad/s
        self._seen, self._begins = 0.0, True
        # s for which each fault was shown.
        self.evidence: dict[FaultKind, float] = dict.fromkeys(WITNESS_CODES, 0.0)
        self.suspected = False
        # Deviation, rad/s, when it last approached its command: its magnitude if it is too fast,
        # otherwise against the command. Infinity, so that the first line counts as approaching:
        # slow motors would otherwise latch "runaway".
        self._nearest = math.inf
        self._wrong = False  # too fast, still or backward in the last line
        self._seconds = self._went = self._way = 0.0

    def coast(self, raw_speed: float, dt: float, count: float) -> None:
        """Process a line while the motor may have no power.

        At rest, `driven` becomes false: until the next command, only a push can turn the wheel.
        """
        self.driven = self.driven and not self._is_surely_slow(raw_speed, dt, count)

    def _is_surely_slow(self, raw_speed: float, dt: float, count: float) -> bool:
        # An encoder with few counts often reports 0 while the wheel turns, so the speed must stay
        # low for the time of one count at `MIN_FAULT_SPEED`.
        self._rested_s = 0.0 if abs(raw_speed) > MIN_FAULT_SPEED else self._rested_s + dt
        return self._rested_s >= count / MIN_FAULT_SPEED and abs(raw_speed) <= MIN_FAULT_SPEED

    def check_speed(
        self,
        raw_speed: float,
        expected: Expected,
        dt: float,
        most: float,
        count: float,
        still: bool,
    ) -> bool:
        """Check the speed in a line, and return whether it is evidence of a fault.

        One line adds at most `most` s. `still` says that all wheels are commanded to stand still.
        """
        goal, command = expected.speed, expected.commanded
        if self._begins:
            self._begins, self.speed = False, raw_speed
        share = dt / (count / SMOOTHING_SPEED + dt)
        speed = self.speed = self.speed + (raw_speed - self.speed) * share
        constant, self._seen = raw_speed == self._seen, raw_speed
        size, wish, turns = abs(goal), abs(command), abs(speed)
        rests = self._is_surely_slow(raw_speed, dt, count) and turns <= MIN_FAULT_SPEED
        driven = self.driven = not still or (self.driven and not rests)
        fastest, least = (size, wish) if size > wish else (wish, size)
        due = self._due + (fastest - self._due) * share
        due = self._due = due if due > fastest else fastest
        moving = size > MIN_FAULT_SPEED and expected.settled
        fast = driven and turns > 1.5 * due + MIN_FAULT_SPEED
        against = moving and speed * goal < 0.0 and turns > 0.3 * size
        # A wheel that slows down sooner than `response_time` says is not dead.
        dead = moving and least > MIN_FAULT_SPEED and abs(raw_speed) < 0.1 * least
        wrong = fast or against or dead
        off = turns if fast else -math.copysign(1.0, command) * speed
        nearing = off < self._nearest - MIN_APPROACH
        if nearing or not wrong:
            self._nearest = off
        elif not self._wrong:
            self._nearest = max(self._nearest, off)
        self._wrong = wrong
        if moving and not wrong:
            self._compare(turns, size, dt)
        stuck = constant and driven and raw_speed != 0.0
        if stuck:
            stuck = (
                min(abs(raw_speed - goal), abs(raw_speed - command))
                > MIN_FAULT_SPEED + 0.4 * fastest
            )
        wrong = wrong and not nearing
        bad = wrong or stuck
        if bad or self.suspected:
            self.suspected = bad
            signs = dead and wrong, against and wrong, fast and wrong, stuck
            for kind, sign in zip(WITNESS_CODES, signs, strict=True):
                self.evidence[kind] = self.evidence[kind] + min(dt, most) if sign else 0.0
        return bad

    def _compare(self, turns: float, size: float, dt: float) -> None:
        self._seconds += dt
        self._went += turns * dt
        self._way += size * dt
        if self._seconds >= RATIO_DRIVE_S:
            self.ratio = self._went / self._way
            self.slow = self.ratio < (FAST_ENOUGH if self.slow else TOO_SLOW)
            self._seconds = self._went = self._way = 0.0
