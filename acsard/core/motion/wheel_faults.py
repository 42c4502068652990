"""Decides which wheel is faulty and which side slips: the wheels of a side check each other.

If they contradict each other (`wheel_residual.py`), and one of them shows the sign of a faulty
encoder and an independent reference contradicts it (`suspect_wheel.py`), the pose ignores that
wheel and the other one stands in. It counts again when both have agreed for a while. Every other
contradiction is slip, and so is a fault until it is proven. A side always keeps one wheel. A wheel
that is blocked or dragged looks like one with a dead encoder and is ignored too, because the other
wheel shows the way driven.
"""

from __future__ import annotations

import math

from acsard.core.link.codec import Motors
from acsard.core.motion.error_model import PERIOD, SMOOTHED
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.suspect_wheel import WORDS, Known, Stuck, Suspect, WheelFault, was_faulty
from acsard.core.motion.wheel_residual import MEMORY_S, Residual
from acsard.core.values import STILL, WHEELS, Event, WheelSpeeds, WheelsStatus

COARSEST, FINEST = math.tau / 16, math.tau / 2000
"""rad. Range in which the angle of a count is learned if none is configured. A wheel that turns
slowly reports one count or none per line."""

RECUR, SOUGHT = 3, 1000
"""Number of times that a small angle must recur within this number of lines to be a count. Damage
makes one."""

COMMANDED = 0.3
"""rad/s. A slower command shows little about which wheel is right."""

SLIP_S = 0.5
"""Seconds after the last contradiction for which a side still counts as slipping."""

SLIP_REPORTED_S = 0.1
"""Seconds of contradiction after which a slip is logged."""

BACK_S = 0.5
"""Seconds for which an ignored wheel must agree, while rolling, to count again."""

Same = tuple[bool, bool, bool, bool]
"""Whether each wheel repeats the speed of the line before, in `WHEELS` order."""

NONE: Same = (False, False, False, False)

LEFT, RIGHT = (1, 2), (0, 3)
"""Indices of the front and the rear wheel of each side in `WHEELS` order."""


class _Side:
    """Two wheels of a side: which of them is ignored, and whether they slip."""

    def __init__(self, name: str, wheels: tuple[int, int]) -> None:
        self.name, self.wheels = name, wheels
        self.residual = Residual()
        self.suspected = False
        self._suspects = (Suspect(), Suspect())
        self._stuck = (Stuck(), Stuck())
        self.out: int | None = None
        """Index of the ignored wheel: 0 for the front one, 1 for the rear one, None without one."""
        self._fault: WheelFault = "dead"
        self.slip_s = self._odd_s = self._agreed_s = 0.0
        self.event: Event | None = None
        """The event of the last line, if any."""

    @property
    def left_out(self) -> str:
        """The ignored wheel's name, "" if both count."""
        return "" if self.out is None else WHEELS[self.wheels[self.out]]

    @property
    def text(self) -> str:
        """The trouble of the side in words, "" without any."""
        if self.out is not None:
            return (
                f"{self.left_out} wheel is left out of the pose: it {WORDS[self._fault]}; check "
                "its encoder"
            )
        if self.slip_s > 0.0:
            return f"{self.name} wheels slip: front and rear turn differently"
        return ""

    def agree(self, dt: float) -> None:
        """Take a line in which the wheels agree."""
        if self.suspected:
            self.suspected = False
            for suspect in self._suspects:
                suspect.forget()
        self._pass(dt)
        if self.out is None or not self.residual.rolling:
            return
        self._agreed_s += dt
        if self._agreed_s >= BACK_S:
            again = (
                f"{self.left_out} wheel agrees with the other wheel of its side again: the "
                "pose uses it"
            )
            self.event = Event("wheel_fault", again, kind="again")
            self.out, self.residual.learns = None, True

    def stands_still(
        self, turned: Motors, same: Same, dt: float, count: float, slow: float, wish: float
    ) -> bool:
        """Test for a stuck encoder; return whether a wheel is ignored from now on."""
        if self.out is not None:
            return False
        for i, stuck in enumerate(self._stuck):
            own, other = self.wheels[i], self.wheels[1 - i]
            turns, apart = same[own] and turned[own] != 0.0, 0.0
            if turns and stuck.left_by(wish):
                apart = turned[other] - turned[own] * self.residual.stand_in(front=i == 1)
            if stuck.says(turns, apart, dt, count, slow, wish):
                self._leave_out(i, "stuck")
                return True
        return False

    def contradict(
        self, turned: Motors, same: tuple[bool, bool], dt: float, count: float, known: Known
    ) -> bool:
        """Take a line in which they contradict; return whether a wheel is ignored from now on."""
        self._agreed_s = 0.0
        if self.out is not None:
            return False
        self.suspected = True
        angles = turned[self.wheels[0]], turned[self.wheels[1]]
        for i, suspect in enumerate(self._suspects):
            own, other = angles[i], angles[1 - i]
            if suspect.looks(own, other, same[i], dt, count):
                suspect.compare(own, other, dt, known)
                if suspect.is_faulty(count):
                    self._leave_out(i, suspect.sign or "dead")
                    return True
        if not self.residual.slips:
            self._pass(dt)
            return False
        self.slip_s, reported = SLIP_S, self._odd_s >= SLIP_REPORTED_S
        self._odd_s += dt
        if self._odd_s >= SLIP_REPORTED_S and not reported:
            self.event = Event("wheel_fault", self.text, "warning", kind="slip")
        return False

    def was_faulty(self, before: WheelSpeeds, now: WheelSpeeds) -> bool:
        """Return whether the ignored wheel may already have been wrong in an earlier line."""
        if self.out is None:
            return False
        own, other = self.wheels[self.out], self.wheels[1 - self.out]
        said = before.as_tuple()
        return was_faulty(self._fault, said[own], said[other], now.as_tuple()[own])

    def _pass(self, dt: float) -> None:
        self.slip_s = max(0.0, self.slip_s - dt)
        if not self.slip_s:
            self._odd_s = 0.0

    def _leave_out(self, i: int, fault: WheelFault) -> None:
        self._fault, self.residual.learns = fault, False
        self.out, self.slip_s, self._odd_s, self.suspected = i, 0.0, 0.0, False
        for suspect in self._suspects:
            suspect.forget()
        self.event = Event("wheel_fault", self.text, "warning", kind="left out")


class WheelFaults:
    """The checks of all wheels: the wheels to ignore, and whether any slips."""

    def __init__(self, kinematics: Kinematics, counts: int, response_time: float) -> None:
        """Start.

        Args:
            kinematics: The kinematics of the base.
            counts: Encoder counts per wheel turn, 0 if unknown.
            response_time: Response time of a slow wheel, s.
        """
        self._kinematics, self._response = kinematics, response_time
        self._count = math.tau / counts if counts else COARSEST
        self._seeking, self._period = not counts, PERIOD
        self._least, self._looked = [COARSEST] * RECUR, 0
        """The smallest angles, rad, that front wheels turned in one line, among the last `_looked`
        lines."""
        self._sides = self._left, self._right = _Side("left", LEFT), _Side("right", RIGHT)
        self._slow_left = self._slow_right = 0.0
        """Speeds of wheels that follow their command slowly, rad/s."""
        self._last = STILL
        self._busy = self._leaves_out = self._stands = False
        self.slips = False
        """Whether the wheels of a side contradict each other now, or did half a second ago."""
        self._found: _Side | None = None
        """The side in which the last line proved a fault."""
        self.events: list[Event] = []
        """Events of the last line."""

    @property
    def status(self) -> WheelsStatus:
        """The ignored wheels, and the sides that slip."""
        sides = self._sides
        return WheelsStatus(
            text="; ".join(side.text for side in sides if side.text),
            left_out=tuple(side.left_out for side in sides if side.left_out),
            slipping=tuple(side.name for side in sides if side.slip_s > 0.0),
            differ=(self._left.residual.ratio, self._right.residual.ratio),
        )

    def believed(self, wheels: Motors) -> Motors:
        """Return four wheel values with ignored wheels replaced by their partners, rad or rad/s."""
        if not self._leaves_out:
            return wheels
        said = list(wheels)
        for side in self._sides:
            if side.out is not None:
                share = side.residual.stand_in(front=side.out == 0)
                said[side.wheels[side.out]] = share * said[side.wheels[1 - side.out]]
        front_right, front_left, rear_left, rear_right = said
        return front_right, front_left, rear_left, rear_right

    def look(
        self,
        turned: Motors,
        speeds: WheelSpeeds,
        dt: float,
        commanded: WheelSpeeds | None = None,
        turn: float | None = None,
    ) -> bool:
        """Take a line: the turned angles, rad, in `dt` s, and its speeds.

        `commanded` is the commanded speeds, rad/s; `turn` is the turn of the wheels that agrees
        with a trusted gyro, rad. Return whether a wheel is ignored from now on; then call
        `was_faulty` for the lines before.
        """
        if self.events:
            self.events = []
        if dt <= 0.0:
            return False
        if commanded is not None:
            share = dt / (self._response + dt)
            self._slow_left += (commanded.front_left - self._slow_left) * share
            self._slow_right += (commanded.front_right - self._slow_right) * share
        if self._seeking:
            self._seek(speeds, dt)
        keep, count = MEMORY_S / (MEMORY_S + dt), self._count
        front_right, front_left, rear_left, rear_right = turned
        left = self._left.residual.add(front_left, rear_left, keep, dt, count)
        right = self._right.residual.add(front_right, rear_right, keep, dt, count)
        last, self._last = self._last, speeds
        same = (
            speeds.front_right == last.front_right,
            speeds.front_left == last.front_left,
            speeds.rear_left == last.rear_left,
            speeds.rear_right == last.rear_right,
        )
        stood, self._stands = self._stands, True in same
        self._found = None
        if stood or self._stands:
            self._found = self._standing(turned, same if stood else NONE, dt, commanded)
        if self._found is None and left and right and not self._busy:
            return False
        for i, side in enumerate(self._sides):
            front, rear = side.wheels
            agree, other_agrees = (right, left) if i else (left, right)
            if side is self._found:
                continue
            if agree:
                side.agree(dt)
                continue
            known = self._known(i, dt, turned, commanded, turn if other_agrees else None)
            if side.contradict(turned, (same[front], same[rear]), dt, count, known):
                self._found = side
        self._sum_up()
        return self._found is not None

    def _standing(
        self, turned: Motors, same: Same, dt: float, commanded: WheelSpeeds | None
    ) -> _Side | None:
        """Return the side with a stuck encoder, None without one."""
        if commanded is None:
            return None
        left, right, count = self._left, self._right, self._count
        of_left = left.stands_still(turned, same, dt, count, self._slow_left, commanded.front_left)
        of_right = right.stands_still(
            turned, same, dt, count, self._slow_right, commanded.front_right
        )
        return right if of_right else left if of_left else None

    def was_faulty(self, before: WheelSpeeds) -> bool:
        """Return whether the wheel that the last line proved faulty was wrong in that line too."""
        return self._found is not None and self._found.was_faulty(before, self._last)

    def _seek(self, speeds: WheelSpeeds, dt: float) -> None:
        """Learn the angle of a count.

        The smallest angle per line that recurs is at least one count.
        """
        self._period += SMOOTHED * (dt - self._period)
        self._looked += 1
        if self._looked > SOUGHT:
            self._least, self._looked = [COARSEST] * RECUR, 1
        for speed in (abs(speeds.front_right), abs(speeds.front_left)):
            if 0.0 < speed * self._period < self._least[-1]:
                self._least[-1] = speed * self._period
                self._least.sort()
                self._count = min(self._count, max(FINEST, self._least[-1]))
                self._seeking = self._count > FINEST

    def _known(
        self, i: int, dt: float, turned: Motors, commanded: WheelSpeeds | None, turn: float | None
    ) -> Known:
        """Return the reference for the left (0) or right (1) side, apart from its own wheels.

        The gyro counts only while the other side agrees, because the turn involves both sides.
        """
        by_gyro = None
        if turn is not None:
            front_right, front_left, rear_left, rear_right = turned
            by_gyro = self._kinematics.opposite(
                (front_left + rear_left) / 2, (front_right + rear_right) / 2, turn
            )[i]
        slow = self._slow_right if i else self._slow_left
        wish = 0.0 if commanded is None else commanded.front_right if i else commanded.front_left
        clear = min(abs(slow), abs(wish)) >= COMMANDED and slow * wish > 0.0
        return Known(slow * dt, wish * dt, clear, by_gyro)

    def _sum_up(self) -> None:
        left, right = self._sides
        self.events = [side.event for side in self._sides if side.event]
        left.event = right.event = None
        self._leaves_out = left.out is not None or right.out is not None
        self.slips = left.slip_s > 0.0 or right.slip_s > 0.0
        self._busy = self.slips or self._leaves_out or left.suspected or right.suspected
