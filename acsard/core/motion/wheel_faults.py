"""Decides which wheel is faulty and which side slips.

The wheels of a side are compared (`wheel_residual.py`). A wheel with the sign of a faulty encoder,
which its command or a gyro contradicts (`suspect_wheel.py`), is ignored for the other one, until
both agree for `RECOVERY_S`. If it contradicts the other and its command for `feedback.fault_time`,
or any wheel its command (`wheel_witness.py`: both of a side may be wrong), the robot latches a
fault. Any other contradiction is slip. A blocked or dragged wheel looks dead and is ignored too. A
wheel that turns after a rest without a command is reported, but no fault, as zeros are sent
already.
"""

from __future__ import annotations

import math
from typing import Literal

from acsard.core.codes import Reason, joined, reason
from acsard.core.config.motion_rules import MIN_EVIDENCE_LINES
from acsard.core.config.settings import FeedbackConfig
from acsard.core.link.codec import Motors
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.suspect_wheel import FAULT_TEXTS, Stuck, Suspect, WheelFault, was_faulty
from acsard.core.motion.wheel_residual import TIME_CONSTANT_S, Residual
from acsard.core.motion.wheel_witness import MIN_FAULT_SPEED, WITNESS_CODES, Expected, Witness
from acsard.core.values import STILL, WHEELS, Event, WheelSpeeds, WheelsStatus

ASSUMED_PERIOD_S = 0.01  # of the feedback lines, before it is measured
PERIOD_GAIN = 0.05  # small, because several lines may be read at the same time

# rad of one count that is learned if the number of counts is not configured.
MAX_COUNT_ANGLE, MIN_COUNT_ANGLE = math.tau / 16, math.tau / 2000

# The angle of a count is the third smallest one that a front wheel rolled in the last lines, as the
# smallest may come from a damaged line.
RECURRENCES, LEARNING_LINES = 3, 1000

MIN_COMMANDED_SPEED = 0.005  # rad/s: a line to the board shows a lower one as 0.00

# s without a command until it is logged (less may be the rocking of a robot), and between logs.
ROLLED_S, REPEATED_S = 0.2, 1.0

SLIP_HOLD_S = 0.5  # after the last contradiction

SLIP_REPORTED_S = 0.1  # until slip is logged

RECOVERY_S = 0.5  # of agreement while both roll, until an ignored wheel is used again

SideName = Literal["left", "right"]

LATE_PERIODS = 1.5  # usual durations of a line, above which its speeds do not show a count

# Counts that a side must miss before both encoders may be the cause. A loaded robot at a fifth of
# its speed reports one earlier.
UNFOLLOWED_COUNTS = 6.0

MAX_UNFOLLOWED_LINE_S = 0.1  # for which a side counts as not following

Same = tuple[bool, bool, bool, bool]  # the speed of the previous line

NO_FAULTS: Same = (False, False, False, False)

LEFT, RIGHT = (1, 2), (0, 3)  # front and rear, by `WHEELS`


class _Side:
    def __init__(self, name: SideName, wheels: tuple[int, int]) -> None:
        self.name, self.wheels = name, wheels
        self.expected, self.residual = Expected(), Residual()
        self.witnesses = Witness(), Witness()
        self.suspected = False
        self._suspects = (Suspect(), Suspect())
        self._stuck = (Stuck(), Stuck())
        self.out: int | None = None  # ignored wheel: 0 is the front, 1 the rear
        self._fault: WheelFault = "dead"
        self.late = False  # a wheel that is not ignored turns too slowly
        # s for which neither wheel has followed, and the further rad expected of both.
        self.unfollowed_s, self._unfollowed = 0.0, (0.0, 0.0)
        self._out_s = 0.0  # s for which the ignored wheel contradicts the other one and its command
        self.slip_s = self._odd_s = self._agreed_s = 0.0
        self.event: Event | None = None

    @property
    def left_out(self) -> str:
        return "" if self.out is None else WHEELS[self.wheels[self.out]]

    @property
    def text(self) -> str:
        if self.out is not None:
            return (
                f"{self.left_out} wheel is left out of the pose: it {FAULT_TEXTS[self._fault]}; "
                "check its encoder"
            )
        if self.slip_s > 0.0:
            return f"{self.name} wheels slip: front and rear turn differently"
        return ""

    @property
    def slow(self) -> list[str]:
        return [
            f"{WHEELS[self.wheels[i]]} {witness.ratio:.0%}"
            for i, witness in enumerate(self.witnesses)
            if witness.slow and i != self.out
        ]

    def forget(self) -> None:
        self._out_s = 0.0
        self.drop_unfollowed()
        for part in (self.expected, *self.witnesses):
            part.forget()

    def watch(self, speeds: Motors, dt: float, most: float, count: float, still: bool) -> bool:
        """Check both wheels, and return whether one of them may be faulty.

        A line adds at most `most` s of evidence. `still` says that all wheels are commanded to
        stand.
        """
        i, j = self.wheels
        front, rear = self.witnesses
        bad_front = front.check_speed(speeds[i], self.expected, dt, most, count, still)
        bad_rear = rear.check_speed(speeds[j], self.expected, dt, most, count, still)
        if bad_front and bad_rear and self.out is None:
            passed = min(dt, MAX_UNFOLLOWED_LINE_S)
            front_angle, rear_angle = self._unfollowed
            self.unfollowed_s += passed
            self._unfollowed = (
                front_angle + (self.expected.speed - speeds[i]) * passed,
                rear_angle + (self.expected.speed - speeds[j]) * passed,
            )
        elif self.unfollowed_s:
            self.drop_unfollowed()
        self.late = (front.slow and self.out != 0) or (rear.slow and self.out != 1)
        return bad_front or bad_rear or self._out_s > 0.0

    def spread(self, front: float, rear: float) -> Motors:
        if self.wheels == LEFT:
            return 0.0, front, rear, 0.0
        return front, 0.0, 0.0, rear

    def drop_unfollowed(self) -> None:
        self.unfollowed_s, self._unfollowed = 0.0, (0.0, 0.0)

    def take_unfollowed(self, count: float) -> tuple[float, float]:
        """Return the further angles that the wheels may have rolled since the last call, rad.

        An encoder with few counts often reports none, so both are 0 until `UNFOLLOWED_COUNTS` are
        expected; then they include all of them.
        """
        if self.unfollowed_s * abs(self.expected.speed) < UNFOLLOWED_COUNTS * count:
            return 0.0, 0.0
        angles, self._unfollowed = self._unfollowed, (0.0, 0.0)
        return angles

    def fault(self, speeds: Motors, limit: float) -> Reason | None:
        for i, witness in enumerate(self.witnesses):
            evidence = dict(witness.evidence)
            if i == self.out:
                evidence[self._fault] = max(evidence[self._fault], self._out_s)
            for kind, lasted in evidence.items():
                if lasted > limit:
                    wheel, command = self.wheels[i], self.expected.commanded
                    name = WHEELS[wheel]
                    figures = f"(commanded {command:.1f}, measured {speeds[wheel]:.1f} rad/s)"
                    code = WITNESS_CODES[kind]
                    return joined(reason(code, part=name, wheel=name, figures=figures))
        return None

    def agree(self, dt: float) -> None:
        if self.suspected:
            self.suspected = False
            for suspect in self._suspects:
                suspect.forget()
        self._pass(dt)
        if self.out is None or not self.residual.rolling:
            return
        self._agreed_s += dt
        if self._agreed_s >= RECOVERY_S:
            again = (
                f"{self.left_out} wheel agrees with the other wheel of its side again: the "
                "pose uses it"
            )
            self.event = Event("wheel_fault", again, kind="again")
            self.out, self._out_s, self.residual.learns = None, 0.0, True

    def finds_stuck(self, turned: Motors, same: Same, dt: float, count: float) -> bool:
        """Return whether this line proves an encoder stuck; the pose then ignores its wheel."""
        if self.out is not None:
            return False
        for i, stuck in enumerate(self._stuck):
            own, other = self.wheels[i], self.wheels[1 - i]
            turns, apart = same[own] and turned[own] != 0.0, 0.0
            if turns and stuck.command_changed(self.expected.commanded):
                apart = turned[other] - turned[own] * self.residual.stand_in(front=i == 1)
            if stuck.add(turns, apart, dt, count, self.expected):
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
        """Process a contradiction; return whether it proves a wheel faulty, which is then ignored.

        `by_gyro` is the angle that this side rolled by a gyro, rad.
        """
        self._agreed_s, fault = 0.0, None if self.out is None else self._fault
        if self.out is not None and self.expected.clear:
            against = self.witnesses[self.out].speed * self.expected.commanded < 0.0
            if fault == "stuck":
                self._out_s = self._out_s + dt if same[self.out] else 0.0
            elif fault == "reversed" and against:
                self._out_s += dt
        # A wheel of a slow robot may be called reversed by mistake, so the other one is tested too.
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
        self.slip_s, reported = SLIP_HOLD_S, self._odd_s >= SLIP_REPORTED_S
        self._odd_s += dt
        if self._odd_s >= SLIP_REPORTED_S and not reported:
            self.event = Event("wheel_fault", self.text, "warning", kind="slip")
        return False

    def was_faulty(self, before: WheelSpeeds, now: WheelSpeeds) -> bool:
        """Return whether the ignored wheel may have been wrong at the speeds `before`."""
        if self.out is None:
            return False
        own, other = self.wheels[self.out], self.wheels[1 - self.out]
        speeds = before.as_tuple()
        return was_faulty(self._fault, speeds[own], speeds[other], now.as_tuple()[own])

    @property
    def may_slip(self) -> bool:
        """Whether the wheels contradict each other, so that one of them may slip."""
        return self.slip_s > 0.0 or self.may_be_right

    @property
    def may_be_right(self) -> bool:
        """Whether the ignored wheel may report its true motion.

        One without motion may be blocked, and an opposite one may have a reversed motor. The side
        then moves as the mean of its wheels.
        """
        return self.out is not None and self._fault != "stuck"

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
    """Decides which wheels the pose ignores, and which sides slip."""

    def __init__(self, kinematics: Kinematics, counts: int, feedback: FeedbackConfig) -> None:
        self._kinematics, self._settings = kinematics, feedback
        self._count = math.tau / counts if counts else MAX_COUNT_ANGLE
        self._most_count = self._count  # the largest possible one, rad
        self._seeking, self._period = not counts, ASSUMED_PERIOD_S
        # The `RECURRENCES` smallest angles of front wheels in the last `_looked` lines.
        self._least, self._looked = [MAX_COUNT_ANGLE] * RECURRENCES, 0
        self._sides = self._left, self._right = _Side("left", LEFT), _Side("right", RIGHT)
        self._last = STILL
        self._busy = self._leaves_out = self._stands = False
        self.slips = False  # within `SLIP_HOLD_S`, or the ignored wheel may be right
        self._rolled, self._unreported = 0.0, REPEATED_S
        self.pushed = ""  # wheels turn without a command, by the last line
        self._late = False
        self._found: _Side | None = None  # the side on which the last line proved a wheel faulty
        self.events: list[Event] = []  # of the last line

    @property
    def status(self) -> WheelsStatus:
        sides = self._sides
        return WheelsStatus(
            text="; ".join(side.text for side in sides if side.text),
            left_out=tuple(side.left_out for side in sides if side.left_out),
            slipping=tuple(side.name for side in sides if side.slip_s > 0.0),
            differ=(self._left.residual.ratio, self._right.residual.ratio),
            slow=tuple(slow for side in sides for slow in side.slow),
        )

    def believed(self, wheels: Motors) -> Motors:
        """Return angles or speeds; the other wheel, times their ratio, replaces a faulty one."""
        if not self._leaves_out:
            return wheels
        values = list(wheels)
        for side in self._sides:
            if side.out is not None:
                share = side.residual.stand_in(front=side.out == 0)
                values[side.wheels[side.out]] = share * values[side.wheels[1 - side.out]]
        front_right, front_left, rear_left, rear_right = values
        return front_right, front_left, rear_left, rear_right

    def possible_motion(self, wheels: Motors) -> list[tuple[SideName, Motors]]:
        """Return, by side, angles that may be true and that the pose leaves out, rad.

        Call this once for each line, after `check_line`. They are the difference of an ignored
        wheel that may be right, and what a side lacks that does not follow its command, where its
        encoders may be wrong.
        """
        found: list[tuple[SideName, Motors]] = []
        if not (self._leaves_out or self._left.unfollowed_s or self._right.unfollowed_s):
            return found  # as for nearly every line
        for side in self._sides:
            if side.may_be_right:
                found.append((side.name, self._ignored(side, wheels)))
            elif side.unfollowed_s:
                front, rear = side.take_unfollowed(self._most_count)
                if front or rear:
                    found.append((side.name, side.spread(front, rear)))
        return found

    def possible_motion_before(self, wheels: Motors) -> list[tuple[SideName, Motors]]:
        """Return `possible_motion` of an earlier line, of the newly faulty wheel only."""
        side = self._found
        if side is None or not side.may_be_right:
            return []
        return [(side.name, self._ignored(side, wheels))]

    def _ignored(self, side: _Side, wheels: Motors) -> Motors:
        believed = self.believed(wheels)
        front, rear = (wheels[wheel] - believed[wheel] for wheel in side.wheels)
        return side.spread(front, rear)

    def forget(self) -> None:
        """Drop the evidence of faults: the link was lost or a fault was cleared."""
        for side in self._sides:
            side.forget()

    def skip(self, wheel_speeds: WheelSpeeds) -> None:
        """Process a line that waited while this computer did not run the daemon.

        It is not checked: the board may have stopped the motors, and the wheels may start again
        from these speeds, but not on a side that is suspected.
        """
        self.pushed, speeds = "", wheel_speeds.as_tuple()
        for side in self._sides:
            side.drop_unfollowed()
            front, rear = side.wheels
            if not any(witness.suspected for witness in side.witnesses):
                side.expected.slow_down(speeds[front], speeds[rear])

    def watch(
        self, commanded: WheelSpeeds | None, wheel_speeds: WheelSpeeds, dt: float
    ) -> Reason | None:
        """Compare a line with the commands; return a fault that names a wheel, or None.

        `commanded` is None while the emergency stop may cut the motors' power. Call `check_line`
        next.
        """
        self.pushed, speeds = "", wheel_speeds.as_tuple()
        if commanded is None:
            for side in self._sides:
                side.forget()
                for wheel, witness in zip(side.wheels, side.witnesses, strict=True):
                    witness.coast(speeds[wheel], dt, self._count)
            return None
        limit, lag = self._settings.fault_time, self._settings.response_time
        left, right = self._left, self._right
        front_right, front_left, rear_left, rear_right = speeds
        left.expected.follow(commanded.front_left, front_left, rear_left, dt, lag)
        right.expected.follow(commanded.front_right, front_right, rear_right, dt, lag)
        still = (
            abs(commanded.front_left) < MIN_COMMANDED_SPEED
            and abs(commanded.front_right) < MIN_COMMANDED_SPEED
        )
        # After a stall of this computer, one line covers all of that time, and proves no fault.
        most, count = limit / MIN_EVIDENCE_LINES, self._count
        bad_left = left.watch(speeds, dt, most, count, still)
        bad_right = right.watch(speeds, dt, most, count, still)
        self._notice(speeds, dt, still)
        if not (limit and (bad_left or bad_right)):
            return None
        return right.fault(speeds, limit) or left.fault(speeds, limit)

    def _notice(self, speeds: Motors, dt: float, still: bool) -> None:
        fastest = 0.0
        if still:
            fastest = max([
                abs(speeds[wheel])
                for side in self._sides
                for wheel, witness in zip(side.wheels, side.witnesses, strict=True)
                if not witness.driven
            ], default=0.0)  # fmt: skip
        self._rolled = self._rolled + dt if fastest > MIN_FAULT_SPEED else 0.0
        self._unreported += dt
        if self._rolled > ROLLED_S and self._unreported >= REPEATED_S:
            self._unreported = 0.0
            self.pushed = (
                f"wheels turn at {fastest:.1f} rad/s without a command: is the robot being pushed?"
            )

    def check_line(
        self, turned: Motors, speeds: WheelSpeeds, dt: float, turn: float | None = None
    ) -> bool:
        """Compare the wheels of each side; return whether this proves a wheel faulty.

        The pose then ignores it, and the caller finds the lines in which it was wrong
        (`was_faulty`). `turned` in the last `dt` s is in rad, and `turn` is by a trusted gyro.
        """
        slow = self._left.late or self._right.late
        if self.events or slow != self._late:
            self.events = [] if slow == self._late else [self._pace(slow)]
            self._late = slow
        if dt <= 0.0:
            return False
        if self._seeking:
            self._seek(speeds, dt)
        keep, count = TIME_CONSTANT_S / (TIME_CONSTANT_S + dt), self._count
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
            self._found = self._standing(turned, same if stood else NO_FAULTS, dt)
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
        left = self._left.finds_stuck(turned, same, dt, self._count)
        right = self._right.finds_stuck(turned, same, dt, self._count)
        return self._right if right else self._left if left else None

    def _pace(self, slow: bool) -> Event:
        if not slow:
            return Event("wheel_fault", "every wheel follows its command again", kind="again")
        text = (
            f"{slow_text(self.status.slow)}; check the load, the battery, and the settings "
            "limits.wheel_speed and feedback.response_time"
        )
        return Event("wheel_fault", text, "warning", kind="slow")

    def was_faulty(self, before: WheelSpeeds) -> bool:
        """Return whether the newly faulty wheel may have been wrong in a line with these speeds."""
        return self._found is not None and self._found.was_faulty(before, self._last)

    def _seek(self, speeds: WheelSpeeds, dt: float) -> None:
        # A wheel that turns reports at least one count. A late line has a mean of several counts.
        late = dt > LATE_PERIODS * self._period
        self._period += PERIOD_GAIN * (dt - self._period)
        if late:
            return
        self._looked += 1
        if self._looked > LEARNING_LINES:
            self._least, self._looked = [MAX_COUNT_ANGLE] * RECURRENCES, 1
        for speed in (abs(speeds.front_right), abs(speeds.front_left)):
            if 0.0 < speed * self._period < self._least[-1]:
                self._least[-1] = speed * self._period
                self._least.sort()
                self._count = min(self._count, max(MIN_COUNT_ANGLE, self._least[-1]))
                self._seeking = self._count > MIN_COUNT_ANGLE

    def _by_gyro(self, i: int, turned: Motors, turn: float) -> float:
        front_right, front_left, rear_left, rear_right = turned
        return self._kinematics.opposite(
            (front_left + rear_left) / 2, (front_right + rear_right) / 2, turn
        )[i]

    def _sum_up(self) -> None:
        left, right = self._sides
        self.events += [side.event for side in self._sides if side.event]
        left.event = right.event = None
        self._leaves_out = left.out is not None or right.out is not None
        self.slips = left.may_slip or right.may_slip
        self._busy = self.slips or self._leaves_out or left.suspected or right.suspected


def slow_text(slow: tuple[str, ...]) -> str:
    wheels = [f"{wheel.replace(' ', ' reaches ')} of its expected speed" for wheel in slow]
    return f"wheels are slower than commanded: {', '.join(wheels)}"
