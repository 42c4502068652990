"""Compares the front and the rear wheel of a side, which have one command and one expected speed.

Their sums differ only if a wheel slips or an encoder is faulty. A wheel that also contradicts the
command or the gyro, and shows a sign of a faulty encoder, is left out of the pose until both agree
for 2 s, and the pose gets back what this wheel falsified before.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

from msgspec import Struct, field

from acsard.core.link.feedback import MAX_FILLED_GAP_S
from acsard.core.link.link_state import WATCHDOG_S
from acsard.core.motion.obedience import AGREEMENT, Expected
from acsard.core.values import WHEELS, Event, Rad, RadPerS, Seconds, Wheels4

SideName = Literal["left", "right"]

# The wheels contradict each other if their sums differ by more than this fraction, counts and rad.
# They slip if they also differ by more than a motor that reacts later (s) explains. The time
# constant of these sums is in s, and s for each rad of a count.
PARTNER_FRACTION, PARTNER_COUNTS, PARTNER_ANGLE, PARTNER_DELAY_S = 0.05, 1.2, 0.002, 0.03
PARTNER_S, PARTNER_S_PER_RAD = 0.14, 5.0

OUT_COUNTS, OUT_ANGLE = 3.5, 0.05  # by which they must differ until one is left out
OUT_BLOCKS = 2
TURNING = 4.0  # ratio of command and expected speed above which the wheels turn around
AGAIN_S = 2.0  # of agreement, until the pose uses a wheel again
SLIP_S, SLIP_REPORTED_S = 0.5, 0.1  # after the last contradiction, and after the first one

# For which a wheel reports one speed, until its encoder may be stuck, and is although the other
# wheel of its side differs little.
SAME_S, PROVEN_S = 0.1, 1.0

OUT_TEXTS = {
    "still": "reports no motion while the other wheel on its side turns",
    "against": "reports a direction opposite to that of the other wheel on its side",
    "repeats": "reports a speed that never changes",
}


class CommandRange(Struct, frozen=True):
    """The commands of a time, of which the board may have obeyed any, and what that may turn.

    Without a line, it stops after `WATCHDOG_S`. Beyond `MAX_FILLED_GAP_S`, nothing is added: then a
    gap has a doubt of its own.
    """

    low: RadPerS = 0.0
    high: RadPerS = 0.0
    seconds: Seconds = 0.0
    least: Rad = 0.0  # by which the wheels may have turned
    most: Rad = 0.0

    def extended(self, command: RadPerS, s: Seconds) -> CommandRange:
        """Return this, and a command that lasted for `s`."""
        low, high = min(self.low, command), max(self.high, command)
        turning = min(s, max(0.0, MAX_FILLED_GAP_S - self.seconds))
        surely = min(turning, WATCHDOG_S)
        least = self.least + low * (surely if low > 0.0 else turning)
        most = self.most + high * (surely if high < 0.0 else turning)
        return CommandRange(low, high, self.seconds + s, least, most)

    def until(self, s: Seconds) -> CommandRange:
        """Return this for at least `s`."""
        return self.extended(self.high, max(0.0, s - self.seconds))

    @property
    def middle(self) -> Rad:
        return (self.least + self.most) / 2

    @property
    def margin(self) -> Rad:
        """By how much the angle may differ from `middle`, with its sign."""
        return math.copysign((self.most - self.least) / 2, self.middle)


class Block(NamedTuple):
    """The sums of some lines, and the bounds for them."""

    s: Seconds
    angles: Wheels4
    line: Wheels4  # the angles of the last line
    speeds: Wheels4  # in it
    unit: Rad  # of an encoder count
    rest: Seconds  # without motion or a command, after which a wheel rests


class Side(Struct):
    name: SideName
    front: int  # its wheels, by `WHEELS`; equal if it has only one
    rear: int
    command: RadPerS = 0.0
    expected: RadPerS = 0.0  # behind the whole response time
    halfway: RadPerS = 0.0  # behind half of it
    due: Expected = field(default_factory=Expected)
    commands: CommandRange = CommandRange()  # since the last line
    commands_in_silence: CommandRange = CommandRange()  # before the block
    angle: Rad = 0.0  # commanded since the last step, and the same behind the lags
    half_angle: Rad = 0.0
    whole_angle: Rad = 0.0
    smooth: tuple[RadPerS, RadPerS, RadPerS] = (0.0, 0.0, 0.0)  # the mean speeds of these
    difference: Rad = 0.0  # recent sum of front minus rear
    rolled: Rad = 0.0  # recent sum of the magnitudes
    net: Rad = 0.0  # recent sum of the mean
    why: str = ""  # the sign of a faulty encoder that one wheel shows
    suspect: int = -1  # this wheel, by `WHEELS`; -1: it may be either
    before: Rad = 0.0  # front minus rear in the block before the first one with this sign
    votes: int = 0  # blocks with this sign, with the angles in them
    of_front: Rad = 0.0
    of_rear: Rad = 0.0
    low: Rad = 0.0  # bounds of what a healthy wheel rolled meanwhile
    high: Rad = 0.0
    out: int = -1  # wheel that the pose leaves out
    repair: Rad = 0.0  # what the pose has too little of it, if it is left out now
    good_s: Seconds = 0.0
    slip_s: Seconds = 0.0  # until the slip counts as ended
    slipped_s: Seconds = 0.0

    @property
    def wheels(self) -> tuple[int, ...]:
        return (self.front,) if self.front == self.rear else (self.front, self.rear)

    def expect(self, command: RadPerS, s: Seconds, lag: Seconds) -> None:
        """Add what a wheel that follows the command behind a lag rolls in a block."""
        # Exact for a command that is constant in the block; the mean of two is, in a ramp.
        goal, self.command = (self.command + command) / 2, command
        self.angle += goal * s
        self.expected, angle = lagged(self.expected, goal, s, lag)
        self.whole_angle += angle
        self.halfway, angle = lagged(self.halfway, goal, s, lag / 2)
        self.half_angle += angle

    def remember(self, s: Seconds, share: float, *before: RadPerS) -> None:
        """End a step of `s` seconds, and smooth its speeds as the measured ones are.

        If no line tells of the step, the wheels may have had the speeds `before`, or none.
        """
        command, half, whole = self.smooth
        command += (self.angle - command * s) * share
        half += (self.half_angle - half * s) * share
        whole += (self.whole_angle - whole * s) * share
        self.smooth = command, half, whole
        stopped = (0.0,) if before else ()
        self.due.add(command, half, whole, *before, *stopped)
        self.angle = self.half_angle = self.whole_angle = 0.0

    def begin(self, speed: RadPerS) -> None:
        """Expect that a wheel of this speed slows down."""
        self.expected = self.halfway = speed

    def forget(self) -> None:
        self.due, self.smooth = Expected(), (0.0, 0.0, 0.0)

    def agrees(self, front: Rad, rear: Rad, keep: float, count: Rad) -> bool:
        """Add the angles of a block to the sums, and return whether they agree."""
        self.difference = keep * (self.difference + front - rear)
        self.net = keep * (self.net + (front + rear) / 2)
        self.rolled = keep * (self.rolled + (abs(front) + abs(rear)) / 2)
        return abs(self.difference) <= self._allowed(count)

    def find_fault(
        self, block: Block, agrees: bool, low: Rad, high: Rad, same_s: tuple[Seconds, Seconds]
    ) -> Event | None:
        """Return an event if a block excludes a wheel, uses it again, or shows a slip.

        A healthy wheel rolled from `low` to `high`. The wheels repeat one speed for `same_s`.
        """
        s = block.s
        self.slip_s = max(0.0, self.slip_s - s)
        if not self.slip_s:
            self.slipped_s = 0.0
        if agrees:
            return self._agree(block)
        self.good_s = 0.0
        if self.out >= 0:
            return None
        if self._exclude(block, low, high, same_s):
            return Event("wheel_fault", self.out_text, "warning", kind="left out")
        if self._slips(block):
            before, self.slipped_s, self.slip_s = self.slipped_s, self.slipped_s + s, SLIP_S
            if before < SLIP_REPORTED_S <= self.slipped_s:
                return Event("wheel_fault", self.slip_text, "warning", kind="slip")
        return None

    @property
    def out_text(self) -> str:
        name = WHEELS[self.out]
        return f"{name} wheel is left out of the pose: it {OUT_TEXTS[self.why]}; check its encoder"

    @property
    def slip_text(self) -> str:
        return f"{self.name} wheels slip: front and rear turn differently"

    def _allowed(self, count: Rad) -> Rad:
        return PARTNER_FRACTION * self.rolled + PARTNER_COUNTS * count + PARTNER_ANGLE

    def _slips(self, block: Block) -> bool:
        speed = (block.angles[self.front] + block.angles[self.rear]) / 2 / block.s
        mean = self.net / (PARTNER_S + PARTNER_S_PER_RAD * block.unit)
        slack = self._allowed(block.unit) + PARTNER_DELAY_S * abs(speed - mean)
        return abs(self.difference) > slack

    def _agree(self, block: Block) -> Event | None:
        if self.out < 0:
            self.why, self.before = "", 0.0
        elif self.rolled > OUT_COUNTS * block.unit + OUT_ANGLE:
            self.good_s += block.s
            if self.good_s >= AGAIN_S:
                name, self.out = WHEELS[self.out], -1
                text = (
                    f"{name} wheel agrees with the other wheel of its side again: the pose uses it"
                )
                return Event("wheel_fault", text, kind="again")
        return None

    def _exclude(self, block: Block, low: Rad, high: Rad, same_s: tuple[Seconds, Seconds]) -> bool:
        # A wheel is left out if it shows a sign of a faulty encoder, and is farther from what a
        # healthy one rolls by a third of the difference.
        if low * high <= 0.0 or max(low / high, high / low) > TURNING:
            return False  # near rest, or while the direction changes, a healthy wheel may do both
        front, rear = self.front, self.rear
        one, other = block.angles[front], block.angles[rear]
        sign = self._sign(one, other, block.unit)
        if sign[0] == "still" and not one == other == 0.0:
            sign = "still", front if abs(one) < abs(other) else rear
        same = [wheel for wheel, s in zip((front, rear), same_s, strict=True) if s >= SAME_S]
        if len(same) == 1 and not sign[0]:
            sign = "repeats", same[0]
        if sign != (self.why, self.suspect):
            self.why, self.suspect = sign
            self.votes, self.of_front, self.of_rear, self.low, self.high = 0, 0.0, 0.0, 0.0, 0.0
        if not self.why:
            self.before = one - other
            return False
        self.votes += 1
        self.of_front += one
        self.of_rear += other
        self.low += low
        self.high += high
        difference = abs(self.of_front - self.of_rear)
        off_front = max(self.low - self.of_front, self.of_front - self.high, 0.0)
        off_rear = max(self.low - self.of_rear, self.of_rear - self.high, 0.0)
        out = front if off_front > off_rear else rear
        if (
            self.votes < OUT_BLOCKS
            or difference < OUT_COUNTS * block.unit + OUT_ANGLE
            or abs(off_front - off_rear) < difference / 3
            or min(off_front, off_rear) > difference / 2
            or self.suspect not in (-1, out)
            # An even wheel may be right, and the other one slip.
            or (
                same_s[out == rear] < PROVEN_S
                and self.why == "repeats"
                and difference < AGREEMENT * max(abs(self.of_front), abs(self.of_rear))
            )
        ):
            return False
        self.out, self.slip_s = out, 0.0
        # The pose has the last line right, and the lines before it wrong.
        missed = self.of_rear - self.of_front - self.before - block.line[rear] + block.line[front]
        self.repair = missed if out == front else -missed
        return True

    def _sign(self, one: Rad, other: Rad, count: Rad) -> tuple[str, int]:
        # Of a faulty encoder. Between two counts, the last sign stays.
        larger = max(abs(one), abs(other))
        if one == other == 0.0 or (one * other == 0.0 and self.why == "against"):
            return self.why, self.suspect
        if one * other < 0.0 and abs(one + other) <= AGREEMENT * larger + OUT_COUNTS * count:
            return "against", -1
        return ("still" if min(abs(one), abs(other)) <= 0.1 * larger else ""), -1


def lagged(speed: RadPerS, goal: RadPerS, s: Seconds, lag: Seconds) -> tuple[RadPerS, Rad]:
    """Return the speed behind a lag at the end of `s` seconds, and the angle in them."""
    before, rest = speed - goal, math.exp(-s / lag)
    return goal + before * rest, goal * s + before * lag * (1.0 - rest)
