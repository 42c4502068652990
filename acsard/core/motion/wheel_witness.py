"""Compares wheels with their commands, and collects the evidence that a wheel is faulty.

`Expected` is the only model of a healthy wheel: its speed follows the command with a first-order
lag. `suspect_wheel.py` uses it to decide which of two wheels is wrong, and `Witness` uses it to
decide whether a wheel follows its command. The limits around the expected speed leave room for
load, slip and coarse encoders. Behavior is evidence only if no healthy wheel shows it, and evidence
proves a fault only if it lasts.

A wheel that stands still, turns against its command or turns too fast is not evidence of a fault
while its speed approaches the command. If a wheel turns in the right direction but too slowly, the
daemon logs a warning with the ratio of the speeds. The cause may be the load, the battery or
`feedback.response_time`.
"""

from __future__ import annotations

import math
from typing import Literal

MIN_FAULT_SPEED = 2.0
"""Smallest wheel speed at which a fault can be recognized, rad/s. At lower speeds, coarse encoders
and a robot at rest can look like any fault."""

MIN_COMMANDED_SPEED = 0.3
"""Smallest commanded speed at which the command can show which of two wheels is right, rad/s."""

SLOW_RESPONSE_FACTOR = 3.0
"""Response time of the wheels of a slow robot, as a multiple of `feedback.response_time`."""

SMOOTHING_SPEED = 1.0
"""Wheel speed that determines the smoothing of the measured speed, rad/s. The time constant of the
smoothing is the time in which a wheel with this speed turns by one encoder count."""

MIN_APPROACH = 1.0
"""Approach of a wheel's speed to its command, rad/s, that excuses the wheel. A wheel may be too
fast, stand still or turn against its command. This is not evidence of a fault if its speed has come
closer to the command by more than this limit."""

RATIO_DRIVE_S = 2.0
"""Time of driving, s, after which the angle that a wheel rolled is compared with the expected
angle."""

TOO_SLOW, FAST_ENOUGH = 0.7, 0.8
"""Ratios of the measured speed of a wheel to its expected speed. A wheel becomes too slow below
`TOO_SLOW`, and is not too slow any more from `FAST_ENOUGH` on."""

FaultKind = Literal["dead", "reversed", "runaway", "stuck"]

WITNESS_TEXTS: dict[FaultKind, str] = {
    "dead": "does not turn, or its encoder is dead: check cable, motor and encoder, and for "
    "motor d also the setting mcu.trailing_comma",
    "reversed": "turns against its command: check the leads of its motor, the wires A and B of its "
    "encoder, and the wheel's sign in mcu.wheels",
    "runaway": "turns faster than commanded: check the motor driver and the encoder",
    "stuck": "reports a speed that never changes: its encoder is stuck",
}


def faster(front: float, rear: float) -> float:
    """Return the one of two wheel speeds that has the larger magnitude."""
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
        """Limit the expected speed to the larger one of two reported speeds, rad/s.

        Call this if the board may have stopped the motors. `front` and `rear` are the reported
        speeds of the two wheels.
        """
        most = faster(front, rear)
        self.speed, self._slow = (
            min(most, old, key=abs) if most * old > 0.0 else 0.0 for old in (self.speed, self._slow)
        )

    def follow(self, commanded: float, front: float, rear: float, dt: float, lag: float) -> None:
        """Update the expected speed with a feedback line.

        Args:
            commanded: the commanded speed of this side, rad/s.
            front: the reported speed of the front wheel, rad/s.
            rear: the reported speed of the rear wheel, rad/s.
            dt: the time since the previous line, s.
            lag: the response time of a healthy wheel, s.
        """
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
        """Whether a healthy wheel must already turn clearly in the direction of the command."""
        self.settled = follows and slow * commanded > 0.0
        """Whether even the wheel of a slow robot must already turn in the direction of the
        command."""


class Witness:
    """The evidence that one wheel does not follow its command, or is slower than expected."""

    def __init__(self) -> None:
        self.driven = False
        """True while any of the four wheels is commanded to turn, and then until this wheel is at
        rest."""
        self.ratio = 1.0
        """Angle that the wheel rolled in the last full `RATIO_DRIVE_S` of driving, divided by the
        expected angle."""
        self.slow = False
        """Whether the wheel turns in the commanded direction, but too slowly."""
        self._due = 0.0
        """Expected magnitude of `speed`, rad/s. It is smoothed like `speed` itself: an encoder with
        few counts needs much smoothing, and then a healthy wheel seems to brake too late."""
        self._rested_s = 0.0
        """Time since the last feedback line with a speed above `MIN_FAULT_SPEED`, s."""
        self.forget()

    def forget(self) -> None:
        """Drop the evidence of faults, but keep `driven`, `ratio` and `slow`.

        These three values describe the motion of the wheel and stay valid.
        """
        self.speed = 0.0
        """Measured speed, smoothed, rad/s."""
        self._seen, self._begins = 0.0, True
        self.evidence: dict[FaultKind, float] = dict.fromkeys(WITNESS_TEXTS, 0.0)
        """Time for which the wheel has shown each fault, s."""
        self.suspected = False
        # Because of the infinity, the first line counts as approaching the command. With 0, a wheel
        # that was already too fast would never count as slowing down, and slow motors would latch
        # "runaway".
        self._nearest = math.inf
        """Deviation from the command when the wheel last approached its command, rad/s. For a wheel
        that is too fast, the deviation is the magnitude of its speed. Otherwise it is the speed of
        the wheel in the direction opposite to the command."""
        self._wrong = False
        """Whether the wheel was too fast, stood still or turned in the wrong direction in the last
        line."""
        self._seconds = self._went = self._way = 0.0

    def coast(self, raw_speed: float, dt: float, count: float) -> None:
        """Process a feedback line while the motor may have no power.

        When the wheel comes to rest, `driven` becomes false: until the next command, only a push
        can turn the wheel. `raw_speed` is the reported speed of the wheel, rad/s. `dt` is the time
        since the previous line, s, and `count` the angle of an encoder count, rad.
        """
        self.driven = self.driven and not self._is_surely_slow(raw_speed, dt, count)

    def _is_surely_slow(self, raw_speed: float, dt: float, count: float) -> bool:
        """Return whether the wheel is certainly not faster than `MIN_FAULT_SPEED`."""
        # An encoder with few counts often reports 0 although the wheel turns. Therefore the
        # reported speed must stay low for the time of one count at the speed `MIN_FAULT_SPEED`.
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
        """Check the wheel speed in a feedback line, and return whether it is evidence of a fault.

        Args:
            raw_speed: the reported speed of the wheel, rad/s.
            expected: the speed of a healthy wheel.
            dt: the time since the previous line, s.
            most: the longest time that one line can add to the evidence, s.
            count: the angle of an encoder count, rad.
            still: whether all wheels are commanded to stand still.
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
        # A wheel that slows down sooner than according to `response_time` is not dead. Therefore
        # compare its speed with the smaller of command and expected speed.
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
            for kind, sign in zip(WITNESS_TEXTS, signs, strict=True):
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
