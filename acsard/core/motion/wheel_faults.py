"""Decides which wheel is faulty and which side slips.

The two wheels of a side are compared with each other (`wheel_residual.py`). If they contradict each
other, one of them may have a faulty encoder. A wheel is faulty if it shows the sign of such a fault
and its command or a gyro contradicts it (`suspect_wheel.py`). The pose then ignores this wheel and
uses the other one in its place.

- If both wheels agree again for `RECOVERY_S` of rolling, the pose uses the ignored wheel again.
- If the ignored wheel contradicts both the other wheel and its command for `feedback.fault_time`,
  the robot latches a fault.
- If any wheel contradicts its command for `feedback.fault_time` (`wheel_witness.py`), the robot
  also latches a fault, because both wheels of a side may be wrong and agree with each other.

Every other contradiction counts as slip. A faulty encoder also counts as slip until the fault is
proven. At most one wheel of each side is ignored. A wheel that is blocked or dragged looks like a
wheel with a dead encoder, so it is ignored too. The other wheel shows the distance driven.

If a wheel has rested and then turns without a command, a hand or a slope turns it. This motion is
reported, but it is never a fault, because the daemon could only react with the zero that it already
sends.
"""

from __future__ import annotations

import math
from typing import Literal

from acsard.core.config.motion_rules import MIN_EVIDENCE_LINES
from acsard.core.config.settings import FeedbackConfig
from acsard.core.link.codec import Motors
from acsard.core.motion.error_model import ASSUMED_PERIOD_S, PERIOD_GAIN
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.suspect_wheel import FAULT_TEXTS, Stuck, Suspect, WheelFault, was_faulty
from acsard.core.motion.wheel_residual import TIME_CONSTANT_S, Residual
from acsard.core.motion.wheel_witness import MIN_FAULT_SPEED, WITNESS_TEXTS, Expected, Witness
from acsard.core.values import STILL, WHEELS, Event, WheelSpeeds, WheelsStatus

MAX_COUNT_ANGLE, MIN_COUNT_ANGLE = math.tau / 16, math.tau / 2000
"""Largest and smallest angle of one encoder count that the daemon learns if the number of counts is
not configured, rad."""

RECURRENCES, LEARNING_LINES = 3, 1000
"""Parameters for learning the angle of one encoder count, if the number of counts is not
configured. The angle is the `RECURRENCES`-th smallest angle that a front wheel rolled in a feedback
line, within `LEARNING_LINES` lines. The smallest angle alone may come from a damaged line."""

MIN_COMMANDED_SPEED = 0.005
"""Smallest commanded wheel speed that does not count as zero, rad/s. The line to the board has two
decimals and shows a lower speed as 0.00."""

ROLLED_S, REPEATED_S = 0.2, 1.0
"""`ROLLED_S` is the time for which wheels must turn without a command before the daemon logs this
motion, s. A shorter motion may be the rocking of a robot that comes to rest. `REPEATED_S` is the
shortest time between two such log lines, s."""

SLIP_HOLD_S = 0.5
"""Time for which a side still counts as slipping after the last contradiction of its wheels, s."""

SLIP_REPORTED_S = 0.1
"""Time for which the two wheels of a side must contradict each other before slip is logged, s."""

RECOVERY_S = 0.5
"""Time for which an ignored wheel must agree with the other wheel of its side while both roll, s.
After this time, the pose uses the ignored wheel again."""

SideName = Literal["left", "right"]

LATE_PERIODS = 1.5
"""Duration of a feedback line, in usual durations, above which its speeds do not show the angle of
an encoder count."""

UNFOLLOWED_COUNTS = 6.0
"""Number of encoder counts that a side must miss before both of its encoders may be the cause. A
loaded robot that drives at a fifth of its expected speed reports a count in less time."""

MAX_UNFOLLOWED_LINE_S = 0.1
"""Longest time of a feedback line for which a side counts as not following its command, s."""

Same = tuple[bool, bool, bool, bool]
"""Whether each wheel reports the same speed as in the previous feedback line, in `WHEELS` order."""

NO_FAULTS: Same = (False, False, False, False)

LEFT, RIGHT = (1, 2), (0, 3)
"""Indices of the front and the rear wheel of each side in `WHEELS` order."""


class _Side:
    """The two wheels of one side: the ignored wheel, and the evidence of faults and slip."""

    def __init__(self, name: SideName, wheels: tuple[int, int]) -> None:
        self.name, self.wheels = name, wheels
        self.expected, self.residual = Expected(), Residual()
        self.witnesses = Witness(), Witness()
        self.suspected = False
        self._suspects = (Suspect(), Suspect())
        self._stuck = (Stuck(), Stuck())
        self.out: int | None = None
        """The wheel that the pose ignores: 0 is the front wheel, 1 is the rear wheel. None if the
        pose uses both wheels."""
        self._fault: WheelFault = "dead"
        self.late = False
        """Whether a wheel that is not ignored turns too slowly."""
        self.unfollowed_s, self._unfollowed = 0.0, (0.0, 0.0)
        """Time for which neither wheel has followed its command, s, and the further angles that the
        wheels would have rolled otherwise, rad."""
        self._out_s = 0.0
        """Time for which the ignored wheel has contradicted both the other wheel of its side and
        its command, s."""
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
        """Check both wheels of this side, and return whether one of them may be faulty.

        `speeds` contains the reported speeds of all four wheels, rad/s. `dt` is the time since the
        previous line, s. One line adds at most `most` s to the evidence of a fault. `count` is the
        angle of an encoder count, rad, and `still` is true if all wheels are commanded to stand
        still.
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
        """Return the values of all four wheels: `front` and `rear` for this side, 0 for the other.

        The values are in `WHEELS` order.
        """
        if self.wheels == LEFT:
            return 0.0, front, rear, 0.0
        return front, 0.0, 0.0, rear

    def drop_unfollowed(self) -> None:
        self.unfollowed_s, self._unfollowed = 0.0, (0.0, 0.0)

    def take_unfollowed(self, count: float) -> tuple[float, float]:
        """Return the further angles that the wheels may have rolled since the last call, rad.

        An encoder with few counts often reports no motion although its wheel turns. Therefore the
        angles are 0 until the expected motion, in the time in which neither wheel has followed its
        command, is `UNFOLLOWED_COUNTS` counts. The first angles after that contain the motion of
        this whole time. `count` is the angle of an encoder count, rad.
        """
        if self.unfollowed_s * abs(self.expected.speed) < UNFOLLOWED_COUNTS * count:
            return 0.0, 0.0
        angles, self._unfollowed = self._unfollowed, (0.0, 0.0)
        return angles

    def fault(self, speeds: Motors, limit: float) -> str:
        for i, witness in enumerate(self.witnesses):
            evidence = dict(witness.evidence)
            if i == self.out:
                evidence[self._fault] = max(evidence[self._fault], self._out_s)
            for kind, lasted in evidence.items():
                if lasted > limit:
                    wheel, command = self.wheels[i], self.expected.commanded
                    return (
                        f"{WHEELS[wheel]} wheel {WITNESS_TEXTS[kind]} (commanded {command:.1f}, "
                        f"measured {speeds[wheel]:.1f} rad/s)"
                    )
        return ""

    def agree(self, dt: float) -> None:
        """Process a feedback line of `dt` s in which the two wheels of this side agree."""
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
        """Return whether this line proves an encoder stuck; the pose then ignores its wheel.

        `same` is whether each wheel repeats its previous speed. `count` is the angle of an encoder
        count, rad.
        """
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
        """Process a line in which the two wheels contradict each other.

        Return whether the line proves a wheel faulty, so that the pose now ignores it. `by_gyro` is
        the angle that this side rolled according to a gyro, rad.
        """
        self._agreed_s, fault = 0.0, None if self.out is None else self._fault
        if self.out is not None and self.expected.clear:
            against = self.witnesses[self.out].speed * self.expected.commanded < 0.0
            if fault == "stuck":
                # A wheel that reports another speed is not stuck.
                self._out_s = self._out_s + dt if same[self.out] else 0.0
            elif fault == "reversed" and against:
                self._out_s += dt
        # On a slow robot, a wheel may be called reversed by mistake. In that case, go on with the
        # test of the other wheel.
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
        """Return whether the ignored wheel may have been wrong already in an earlier line.

        `before` contains the wheel speeds in that line, and `now` the present wheel speeds, all in
        rad/s.
        """
        if self.out is None:
            return False
        own, other = self.wheels[self.out], self.wheels[1 - self.out]
        speeds = before.as_tuple()
        return was_faulty(self._fault, speeds[own], speeds[other], now.as_tuple()[own])

    @property
    def may_slip(self) -> bool:
        """Whether the wheels of this side contradict each other, so that one of them may slip."""
        return self.slip_s > 0.0 or self.may_be_right

    @property
    def may_be_right(self) -> bool:
        """Whether the pose ignores a wheel of this side that may report its true motion.

        A wheel that reports no motion may have a dead encoder, or it may be blocked. A wheel that
        reports the opposite motion may have a reversed encoder or a reversed motor. If the wheel is
        right, the side moves as the mean of its two wheels, and not as the other wheel.
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
    """Checks all wheels. Decides which wheels the pose ignores, and which sides slip."""

    def __init__(self, kinematics: Kinematics, counts: int, feedback: FeedbackConfig) -> None:
        """Start without evidence of a fault.

        `counts` is the number of encoder counts per revolution of a wheel; 0 if it is unknown.
        """
        self._kinematics, self._settings = kinematics, feedback
        self._count = math.tau / counts if counts else MAX_COUNT_ANGLE
        self._most_count = self._count
        """Largest possible angle of an encoder count, rad."""
        self._seeking, self._period = not counts, ASSUMED_PERIOD_S
        self._least, self._looked = [MAX_COUNT_ANGLE] * RECURRENCES, 0
        """`_least` contains the `RECURRENCES` smallest angles that a front wheel rolled in one of
        the last `_looked` feedback lines, rad."""
        self._sides = self._left, self._right = _Side("left", LEFT), _Side("right", RIGHT)
        self._last = STILL
        self._busy = self._leaves_out = self._stands = False
        self.slips = False
        """Whether a side may slip: its wheels contradicted each other in the last `SLIP_HOLD_S`, or
        one of them is ignored although it may be right."""
        self._rolled, self._unreported = 0.0, REPEATED_S
        self.pushed = ""
        """Message that wheels turn without a command, for example by hand; "" unless the last line
        causes this message."""
        self._late = False
        self._found: _Side | None = None
        """The side on which the last feedback line proved a wheel faulty, or None."""
        self.events: list[Event] = []
        """Log events of the last feedback line."""

    @property
    def status(self) -> WheelsStatus:
        """The state of the wheels: ignored wheels, slow wheels, and the sides that slip."""
        sides = self._sides
        return WheelsStatus(
            text="; ".join(side.text for side in sides if side.text),
            left_out=tuple(side.left_out for side in sides if side.left_out),
            slipping=tuple(side.name for side in sides if side.slip_s > 0.0),
            differ=(self._left.residual.ratio, self._right.residual.ratio),
            slow=tuple(slow for side in sides for slow in side.slow),
        )

    def believed(self, wheels: Motors) -> Motors:
        """Return `wheels`, with the value of each faulty wheel replaced.

        The new value is that of the other wheel of its side, times the learned ratio of these two
        wheels. The values are angles (rad) or speeds (rad/s) in `WHEELS` order.
        """
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
        """Return the angles that the wheels may have rolled and that the pose leaves out, rad.

        Call this once for each feedback line, after `check_line`.

        - The pose ignores a wheel that may be right (`_Side.may_be_right`). The angle is the
          difference from the angle that replaces it.
        - Neither wheel of a side follows its command. The cause may be the encoders of this side.
          The angle is the difference from the expected angle.

        The result contains each side with such a wheel, and the angles of all wheels, in `WHEELS`
        order. The angle of each other wheel is 0. `wheels` contains the angles that the wheels
        reported, rad.
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
        """Return what `possible_motion` would have returned for an earlier line, rad.

        The newly faulty wheel is included, and no other one, because it was not yet ignored then.
        """
        side = self._found
        if side is None or not side.may_be_right:
            return []
        return [(side.name, self._ignored(side, wheels))]

    def _ignored(self, side: _Side, wheels: Motors) -> Motors:
        """Return the angle by which the ignored wheel of `side` differs from its replacement."""
        believed = self.believed(wheels)
        front, rear = (wheels[wheel] - believed[wheel] for wheel in side.wheels)
        return side.spread(front, rear)

    def forget(self) -> None:
        """Drop the evidence of faults, because the link was lost or a fault was cleared."""
        for side in self._sides:
            side.forget()

    def skip(self, wheel_speeds: WheelSpeeds) -> None:
        """Process a feedback line that waited while this computer did not run the daemon.

        The line is not checked, because the board may have stopped the motors meanwhile. From now
        on, the checks expect the wheels to start again from at most the speeds `wheel_speeds`,
        rad/s. On a side with a wheel that is already suspected, the expected speeds do not change.
        """
        self.pushed, speeds = "", wheel_speeds.as_tuple()
        for side in self._sides:
            side.drop_unfollowed()
            front, rear = side.wheels
            if not any(witness.suspected for witness in side.witnesses):
                side.expected.slow_down(speeds[front], speeds[rear])

    def watch(self, commanded: WheelSpeeds | None, wheel_speeds: WheelSpeeds, dt: float) -> str:
        """Compare the wheel speeds in a feedback line with their commands.

        If a wheel has contradicted its command for `feedback.fault_time`, return the reason of a
        fault, which names the wheel. Otherwise return "". In both cases, the caller must call
        `check_line` for the same line next.

        Args:
            commanded: the commanded wheel speeds, rad/s. None means that the motors may have no
                power, because the emergency stop counts as pressed.
            wheel_speeds: the reported wheel speeds, rad/s.
            dt: the time since the previous line, s.
        """
        self.pushed, speeds = "", wheel_speeds.as_tuple()
        if commanded is None:
            for side in self._sides:
                side.forget()
                for wheel, witness in zip(side.wheels, side.witnesses, strict=True):
                    witness.coast(speeds[wheel], dt, self._count)
            return ""
        limit, lag = self._settings.fault_time, self._settings.response_time
        left, right = self._left, self._right
        front_right, front_left, rear_left, rear_right = speeds
        left.expected.follow(commanded.front_left, front_left, rear_left, dt, lag)
        right.expected.follow(commanded.front_right, front_right, rear_right, dt, lag)
        still = (
            abs(commanded.front_left) < MIN_COMMANDED_SPEED
            and abs(commanded.front_right) < MIN_COMMANDED_SPEED
        )
        # If this computer did not run the daemon for a while, one line covers all of that time.
        # This line alone must not prove a fault.
        most, count = limit / MIN_EVIDENCE_LINES, self._count
        bad_left = left.watch(speeds, dt, most, count, still)
        bad_right = right.watch(speeds, dt, most, count, still)
        self._notice(speeds, dt, still)
        if not (limit and (bad_left or bad_right)):
            return ""
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
        """Compare the wheels of each side, and return whether this line proves a wheel faulty.

        If it does, the pose ignores the faulty wheel from now on. The caller must find the earlier
        lines in which this wheel was wrong (`was_faulty`).

        Args:
            turned: the angles that the wheels rolled in the last `dt` s, rad.
            speeds: the reported wheel speeds, rad/s.
            dt: the time in which the wheels rolled these angles, s.
            turn: the turn of the robot that the wheels should show according to a gyro, rad; None
                without a trusted gyro.
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
        """Return whether the newly faulty wheel may already have been wrong in an earlier line.

        `before` contains the wheel speeds in that line, rad/s.
        """
        return self._found is not None and self._found.was_faulty(before, self._last)

    def _seek(self, speeds: WheelSpeeds, dt: float) -> None:
        """Learn the angle of one encoder count from the speeds in a feedback line.

        A wheel that turns reports at least one count. Therefore the smallest angle that recurs in
        the lines is the angle of a count (`RECURRENCES`).
        """
        # A line that covers more time has a mean of several counts, which says nothing about one.
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
        """Return the angle that one side rolled, rad, computed from the gyro and the other side.

        `i` is 0 for the left side and 1 for the right side. `turned` contains the angles that the
        wheels rolled, and `turn` is the turn of the robot according to the gyro, both in rad. The
        wheels of the other side must agree with each other.
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
        self.slips = left.may_slip or right.may_slip
        self._busy = self.slips or self._leaves_out or left.suspected or right.suspected


def slow_text(slow: tuple[str, ...]) -> str:
    """Return a text that names the slow wheels. `slow` is the value of `WheelsStatus.slow`."""
    wheels = [f"{wheel.replace(' ', ' reaches ')} of its expected speed" for wheel in slow]
    return f"wheels are slower than commanded: {', '.join(wheels)}"
