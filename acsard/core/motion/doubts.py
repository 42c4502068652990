"""Holds what the wheels show otherwise than it was commanded: the pose may have it wrong.

Nothing tells a motor that does not obey from an encoder that lies. So all of the difference of a
side and its command is in doubt at once, whatever its cause and the verdict on its wheels will be:
in the covariance, the deviation of the distance is the difference's share of the way. A delay of
the motor, and a slope that the robot drives up and down, give it back. A large difference is said,
too. Two wheels of a side that contradict each other are in doubt by half of their difference.

A step is compared when it is long enough for the counts. Until then all of its difference is in
doubt, too: counts that have not come yet take it back.

In a silence the board may have obeyed any command of that time (`CommandRange`). So the middle of
what it may have done is compared, and half of the range is a doubt beside it. Both are kept apart:
the lines around a silence tell nothing of it, and take nothing of its doubt back.
"""

from __future__ import annotations

from typing import NamedTuple

from msgspec import Struct, field

from acsard.core.motion.gaps import AT_REST, plus
from acsard.core.motion.obedience import AGREEMENT
from acsard.core.motion.sides import SideName, lagged
from acsard.core.motion.wheels import Wheels
from acsard.core.values import Rad, RadPerS, Seconds, Wheels4

# A step is long enough for a comparison after these counts, or this time.
STEP_COUNTS, STEP_S = 6.0, 1.0
NOISE_COUNTS = 1.5  # of an angle

# A difference is said beyond this share of the recent way, this time at the fastest speed, beside
# the response time, and these counts.
SHARE, DELAY_S, COUNTS = 0.05, 1.0, 2.0
MEMORY_S = 30.0  # of driving


class Trail(Struct):
    """What one side shows otherwise than commanded, rad."""

    expected: RadPerS = 0.0  # command behind half of the response time: a motor may be quicker
    fastest: RadPerS = 0.0  # expected in about `MEMORY_S`
    due: Rad = 0.0  # in the open step
    shown: Rad = 0.0
    seconds: Seconds = 0.0
    recent: Rad = 0.0  # due in either direction, in `MEMORY_S`
    short: Rad = 0.0  # due minus shown, in `MEMORY_S`
    astray: Rad = 0.0  # the part of it in steps that differ by more than `AGREEMENT`
    weak: bool = False  # more than a delay explains: said while it lasts
    differs: bool = False  # so much beyond `AGREEMENT`: said until the pose is set

    def follow(self, command: RadPerS, angle: Rad, s: Seconds, lag: Seconds) -> None:
        """Add a motion to the open step."""
        self.expected, due = lagged(self.expected, command, s, lag / 2)
        self.fastest = max(self.fastest, abs(self.expected))
        self.due += due
        self.shown += angle
        self.seconds += s

    def disagrees(self, count: Rad) -> bool:
        size = max(abs(self.due), abs(self.shown))
        return abs(self.due - self.shown) > AGREEMENT * size + NOISE_COUNTS * count

    def ends(self, count: Rad) -> bool:
        """Return whether the open step is long enough for a comparison."""
        size = max(abs(self.due), abs(self.shown))
        return self.disagrees(count) or size >= STEP_COUNTS * count or self.seconds >= STEP_S

    def end(self, lag: Seconds, count: Rad, *, said: bool = True) -> None:
        """End the step, whose difference is in doubt as one standard deviation.

        Of a silence, nothing is `said`: the wheels may have obeyed another command in it.
        """
        more, disagrees, size = self.due - self.shown, self.disagrees(count), abs(self.due)
        if not said:
            self.due = self.shown = self.seconds = 0.0
            return
        keep = 1.0 / (1.0 + self.seconds / MEMORY_S) if size or self.shown else 1.0
        self.recent, self.fastest = keep * self.recent + size, keep * self.fastest
        self.short = keep * self.short + more
        self.astray = keep * self.astray + disagrees * more
        self.due = self.shown = self.seconds = 0.0
        most = SHARE * self.recent + (DELAY_S + lag) * self.fastest + COUNTS * count
        self.weak = abs(self.short) > (most / 2 if self.weak else most)
        self.differs |= min(abs(self.astray), abs(self.short)) > most

    def restart(self, speed: RadPerS) -> None:
        """Note that nobody knows what is expected of a side with this speed."""
        self.expected, self.due, self.shown, self.seconds = speed, 0.0, 0.0, 0.0

    def forget(self) -> None:
        self.astray = self.short = self.recent = 0.0
        self.due = self.shown = self.seconds = 0.0
        self.weak = self.differs = False


class Step(NamedTuple):
    """Angles of the sides that the pose may have missed in a step, rad."""

    astray: Wheels4 = AT_REST
    margin: Wheels4 = AT_REST  # in a silence
    silent: bool = False  # a silence may be the cause


class Found(NamedTuple):
    ended: Step
    open: Step  # it replaces that of the last update
    # Angles that the pose may have missed on a side whose wheels contradict each other, rad.
    wheels: list[tuple[SideName, Wheels4]]


class Doubts(Struct):
    left: Trail = field(default_factory=Trail)
    right: Trail = field(default_factory=Trail)
    # Since the last update.
    commanded: tuple[Rad, Rad] = (0.0, 0.0)  # of the left and the right side
    rolled: Wheels4 = AT_REST
    used: Wheels4 = AT_REST  # by the pose
    seconds: Seconds = 0.0
    unknown: bool = False  # an emergency stop may have cut the power
    silent: bool = False  # a line ended a silence
    margin: tuple[Rad, Rad] = (0.0, 0.0)  # of the sides in it, more or less than `commanded`

    @property
    def differs(self) -> bool:
        """Whether `state` says that the wheels differ from the commands."""
        return any(trail.differs or trail.weak for trail in (self.left, self.right))

    def add(self, wheels: Wheels, rolled: Wheels4, seconds: Seconds) -> None:
        """Add a line, in which the wheels rolled by these angles."""
        left, right = self.commanded
        if wheels.unseen:
            self.silent = True
            of_left, of_right = (side.commands_in_silence.until(seconds) for side in wheels.sides)
            self.commanded = left + of_left.middle, right + of_right.middle
            left, right = self.margin
            self.margin = left + of_left.margin, right + of_right.margin
        elif wheels.commanded is None:
            self.unknown = True
        else:
            now = wheels.commanded
            self.commanded = left + now.front_left * seconds, right + now.front_right * seconds
        self.rolled, self.used = plus(self.rolled, rolled), plus(self.used, wheels.believed(rolled))
        if wheels.excludes:
            self.used = plus(self.used, wheels.repair)
        self.seconds += seconds
        if wheels.fault is not None:
            self.left.differs = self.right.differs = True

    def update(self, wheels: Wheels, lag: Seconds, count: Rad) -> Found:
        """End the open lines, and return what is in doubt now."""
        s, rolled, used = self.seconds, self.rolled, self.used
        ended, wheels_astray = Step(), list[tuple[SideName, Wheels4]]()
        trails = (self.left, self.right)
        for trail, side, commanded in zip(trails, wheels.sides, self.commanded, strict=True):
            if s <= 0.0:
                break
            angle = (used[side.front] + used[3 - side.front]) / 2
            if all(wheels.wheels[i].rested for i in side.wheels):
                trail.restart(0.0)
            elif self.unknown and not self.silent:
                trail.restart(angle / s)
            else:
                trail.follow(commanded / s, angle, s, lag)
            if side.out >= 0 or side.slip_s > 0.0:
                half = (rolled[side.front] - rolled[side.rear]) / 2
                wheels_astray.append((side.name, of_side(side.front, half)))
        # One side alone would be in doubt of a turn.
        if self.left.ends(count) or self.right.ends(count):
            ended = self._step()
            for trail in trails:
                trail.end(lag, count, said=not self.silent)
            self.silent, self.margin = False, (0.0, 0.0)
        self.commanded, self.seconds, self.unknown = (0.0, 0.0), 0.0, False
        self.rolled = self.used = AT_REST
        return Found(ended, self._step(), wheels_astray)

    def _step(self) -> Step:
        left, right = (trail.due - trail.shown for trail in (self.left, self.right))
        of_left, of_right = self.margin
        margin = of_right, of_left, of_left, of_right
        return Step((right, left, left, right), margin, self.silent)

    def forget(self) -> None:
        """Forget all doubts: the pose was set."""
        self.left.forget()
        self.right.forget()


def of_side(front: int, angle: Rad) -> Wheels4:
    return (angle, 0.0, 0.0, angle) if front == 0 else (0.0, angle, angle, 0.0)
