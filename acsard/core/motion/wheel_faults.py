"""Decides which wheel is faulty and which side slips.

Each wheel has one way from suspicion to a fault. The wheels of a side check each other
(`wheel_residual.py`). If they contradict each other, and one of them shows the sign of a faulty
encoder and an independent reference contradicts it (`suspect_wheel.py`), the pose ignores that
wheel and the other one stands in. It counts again when both have agreed for a while. If instead it
contradicts the other one for `feedback.fault_time` of commanded motion, it is a fault. So is a
wheel that contradicts its command for this time (`wheel_witness.py`): the other one may do so too.

Every other contradiction is slip, and so is a fault until it is proven. A side always keeps one
wheel. A wheel that is blocked or dragged looks like one with a dead encoder and is ignored too,
because the other wheel shows the way driven.

A wheel that turns after a rest without a command is turned by something else: a hand, or a slope.
That is reported but is never a fault, because a fault could only send the zero that is being sent
anyway.
"""

from __future__ import annotations

import math

from acsard.core.config.motion_rules import LINES_OF_EVIDENCE
from acsard.core.config.settings import FeedbackConfig
from acsard.core.link.codec import Motors
from acsard.core.motion.error_model import PERIOD, SMOOTHED
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.suspect_wheel import WORDS, Stuck, Suspect, WheelFault, was_faulty
from acsard.core.motion.wheel_residual import MEMORY_S, Residual
from acsard.core.motion.wheel_witness import FAULTS, SLACK, Expected, Witness
from acsard.core.values import STILL, WHEELS, Event, WheelSpeeds, WheelsStatus

COARSEST, FINEST = math.tau / 16, math.tau / 2000
"""rad. Range in which the angle of a count is learned if none is configured. A wheel that turns
slowly reports one count or none per line."""

RECUR, SOUGHT = 3, 1000
"""Number of times that a small angle must recur within this number of lines to be a count. Damage
makes one."""

LEAST = 0.005
"""rad/s. A line reports a smaller speed as zero."""

ROLLED_S, REPEATED_S = 0.2, 1.0
"""Seconds for which wheels must turn by hand before it is reported, and least seconds between two
reports. A robot that rocks to rest is not pushed."""

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
    """Two wheels of a side: what they should do, which is ignored, and whether they slip."""

    def __init__(self, name: str, wheels: tuple[int, int]) -> None:
        self.name, self.wheels = name, wheels
        self.expected, self.residual = Expected(), Residual()
        self.witnesses = Witness(), Witness()
        self.suspected = False
        self._suspects = (Suspect(), Suspect())
        self._stuck = (Stuck(), Stuck())
        self.out: int | None = None
        """Index of the ignored wheel: 0 for the front one, 1 for the rear one, None without one."""
        self._fault: WheelFault = "dead"
        self.late = False
        """Whether a wheel that counts turns too slowly."""
        self._out_s = 0.0
        """Seconds for which the ignored wheel has contradicted the other one and its command."""
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

    @property
    def slow(self) -> list[str]:
        """The wheels that turn too slowly, each with its ratio; an ignored wheel is none."""
        return [
            f"{WHEELS[self.wheels[i]]} {witness.ratio:.0%}"
            for i, witness in enumerate(self.witnesses)
            if witness.slow and i != self.out
        ]

    def forget(self) -> None:
        """Drop the evidence of faults. An ignored wheel stays ignored."""
        self._out_s = 0.0
        for part in (self.expected, *self.witnesses):
            part.forget()

    def watch(self, seen: Motors, dt: float, most: float, count: float, still: bool) -> bool:
        """Hold both wheels against the command; return whether there is evidence of a fault."""
        i, j = self.wheels
        front, rear = self.witnesses
        bad = front.look(seen[i], self.expected, dt, most, count, still)
        bad = rear.look(seen[j], self.expected, dt, most, count, still) or bad
        self.late = (front.slow and self.out != 0) or (rear.slow and self.out != 1)
        return bad or self._out_s > 0.0

    def fault(self, seen: Motors, limit: float) -> str:
        """Return the fault that has lasted longer than `limit` s in words, "" without one."""
        for i, witness in enumerate(self.witnesses):
            evidence = dict(witness.evidence)
            if i == self.out:
                evidence[self._fault] = max(evidence[self._fault], self._out_s)
            for kind, lasted in evidence.items():
                if lasted > limit:
                    wheel, told = self.wheels[i], self.expected.commanded
                    return (
                        f"{WHEELS[wheel]} wheel {FAULTS[kind]} (commanded {told:.1f}, measured "
                        f"{seen[wheel]:.1f} rad/s)"
                    )
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
            self.out, self._out_s, self.residual.learns = None, 0.0, True

    def stands_still(self, turned: Motors, same: Same, dt: float, count: float) -> bool:
        """Test for a stuck encoder; return whether a wheel is ignored from now on."""
        if self.out is not None:
            return False
        for i, stuck in enumerate(self._stuck):
            own, other = self.wheels[i], self.wheels[1 - i]
            turns, apart = same[own] and turned[own] != 0.0, 0.0
            if turns and stuck.left_by(self.expected.commanded):
                apart = turned[other] - turned[own] * self.residual.stand_in(front=i == 1)
            if stuck.says(turns, apart, dt, count, self.expected):
                self._leave_out(i, "stuck")
                return True
        return False

    def contradict(
        self,
        turned: Motors,
        same: tuple[bool, bool],
        dt: float,
        count: float,
        by_gyro: float | None,
    ) -> bool:
        """Take a line in which they contradict; return whether a wheel is ignored from now on."""
        self._agreed_s, fault = 0.0, None if self.out is None else self._fault
        if self.out is not None and self.expected.clear:
            against = self.witnesses[self.out].speed * self.expected.commanded < 0.0
            if fault == "stuck" or (fault == "reversed" and against):
                self._out_s += dt
        # Which of two wheels is reversed may have been wrong on a slow robot.
        if fault in ("dead", "stuck"):
            return False
        self.suspected = True
        angles = turned[self.wheels[0]], turned[self.wheels[1]]
        for i, suspect in enumerate(self._suspects):
            own, other = angles[i], angles[1 - i]
            if i != self.out and suspect.looks(own, other, same[i], dt, count):
                suspect.compare(own, other, dt, count, self.expected, by_gyro)
                if suspect.is_faulty(count) and fault in (None, suspect.sign):
                    self._leave_out(i, suspect.sign or "dead")
                    return True
        if fault or not self.residual.slips:
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
        self._fault, self._out_s, self.residual.learns = fault, 0.0, False
        self.out, self.slip_s, self._odd_s, self.suspected = i, 0.0, 0.0, False
        for suspect in self._suspects:
            suspect.forget()
        self.event = Event("wheel_fault", self.text, "warning", kind="left out")


class WheelFaults:
    """The checks of all wheels: the wheels to ignore, and whether any slips."""

    def __init__(self, kinematics: Kinematics, counts: int, feedback: FeedbackConfig) -> None:
        """Start.

        Args:
            kinematics: The kinematics of the base.
            counts: Encoder counts per wheel turn, 0 if unknown.
            feedback: The table `[feedback]` with the response time and the fault time.
        """
        self._kinematics, self._settings = kinematics, feedback
        self._count = math.tau / counts if counts else COARSEST
        self._seeking, self._period = not counts, PERIOD
        self._least, self._looked = [COARSEST] * RECUR, 0
        """The smallest angles, rad, that front wheels turned in one line, among the last `_looked`
        lines."""
        self._sides = self._left, self._right = _Side("left", LEFT), _Side("right", RIGHT)
        self._last = STILL
        self._busy = self._leaves_out = self._stands = False
        self.slips = False
        """Whether the wheels of a side contradict each other now, or did half a second ago."""
        self._rolled, self._unreported = 0.0, REPEATED_S
        self.pushed = ""
        """The message of the last line about wheels turned by hand, or ""."""
        self._late = False
        """Whether a wheel turns too slowly."""
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
            slow=tuple(slow for side in sides for slow in side.slow),
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

    def forget(self) -> None:
        """Drop the evidence of faults, because the link was lost or a fault was cleared."""
        for side in self._sides:
            side.forget()

    def watch(self, commanded: WheelSpeeds | None, seen: WheelSpeeds, dt: float) -> str:
        """Hold a line `dt` s after the one before against the command; call it before `look`.

        `commanded` is the commanded speeds, rad/s, None if the motors have no power; `seen` is the
        reported ones. Return the fault that the lines prove, naming the wheel, or "".
        """
        self.pushed = ""
        if commanded is None:
            self.forget()
            return ""
        limit, lag = self._settings.fault_time, self._settings.response_time
        left, right, speeds = self._left, self._right, seen.as_tuple()
        front_right, front_left, rear_left, rear_right = speeds
        left.expected.follow(commanded.front_left, front_left, rear_left, dt, lag)
        right.expected.follow(commanded.front_right, front_right, rear_right, dt, lag)
        still = abs(commanded.front_left) < LEAST and abs(commanded.front_right) < LEAST
        # After a stall of the host, one line stands for the whole stall and must prove no fault.
        most, count = limit / LINES_OF_EVIDENCE, self._count
        bad_left = left.watch(speeds, dt, most, count, still)
        bad_right = right.watch(speeds, dt, most, count, still)
        self._notice(speeds, dt, still)
        if not (limit and (bad_left or bad_right)):
            return ""
        return right.fault(speeds, limit) or left.fault(speeds, limit)

    def _notice(self, speeds: Motors, dt: float, still: bool) -> None:
        """Report, at intervals, wheels that turn after a rest against their command."""
        fastest = 0.0
        if still:
            fastest = max([
                abs(speeds[wheel])
                for side in self._sides
                for wheel, witness in zip(side.wheels, side.witnesses, strict=True)
                if not witness.driven
            ], default=0.0)  # fmt: skip
        self._rolled = self._rolled + dt if fastest > SLACK else 0.0
        self._unreported += dt
        if self._rolled > ROLLED_S and self._unreported >= REPEATED_S:
            self._unreported = 0.0
            self.pushed = (
                f"wheels turn at {fastest:.1f} rad/s without a command: is the robot being pushed?"
            )

    def look(
        self, turned: Motors, speeds: WheelSpeeds, dt: float, turn: float | None = None
    ) -> bool:
        """Take a line: the turned angles, rad, in `dt` s, and its speeds.

        `turn` is the turn of the wheels that agrees with a trusted gyro, rad. Return whether a
        wheel is ignored from now on; then call `was_faulty` for the lines before.
        """
        slow = self._left.late or self._right.late
        if self.events or slow != self._late:
            self.events = [] if slow == self._late else [self._pace(slow)]
            self._late = slow
        if dt <= 0.0:
            return False
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
            self._found = self._standing(turned, same if stood else NONE, dt)
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
            by_gyro = None if turn is None or not other_agrees else self._by_gyro(i, turned, turn)
            if side.contradict(turned, (same[front], same[rear]), dt, count, by_gyro):
                self._found = side
        self._sum_up()
        return self._found is not None

    def _standing(self, turned: Motors, same: Same, dt: float) -> _Side | None:
        """Return the side with a stuck encoder, None without one."""
        left = self._left.stands_still(turned, same, dt, self._count)
        right = self._right.stands_still(turned, same, dt, self._count)
        return self._right if right else self._left if left else None

    def _pace(self, slow: bool) -> Event:
        if not slow:
            return Event("wheel_fault", "every wheel follows its command again", kind="again")
        text = (
            f"slower than commanded: {', '.join(self.status.slow)} of the expected speed; check "
            "load and battery, limits.wheel_speed and feedback.response_time"
        )
        return Event("wheel_fault", text, "warning", kind="slow")

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

    def _by_gyro(self, i: int, turned: Motors, turn: float) -> float:
        """Return the angle of the left (0) or right (1) side by the gyro and the other side, rad.

        It counts only while the other side agrees.
        """
        front_right, front_left, rear_left, rear_right = turned
        return self._kinematics.opposite(
            (front_left + rear_left) / 2, (front_right + rear_right) / 2, turn
        )[i]

    def _sum_up(self) -> None:
        left, right = self._sides
        self.events += [side.event for side in self._sides if side.event]
        left.event = right.event = None
        self._leaves_out = left.out is not None or right.out is not None
        self.slips = left.slip_s > 0.0 or right.slip_s > 0.0
        self._busy = self.slips or self._leaves_out or left.suspected or right.suspected
