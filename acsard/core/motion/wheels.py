"""Decides whether each wheel obeys its command.

`obedience.py` sums the motion of a wheel that no delay of its motor explains. Beyond 1 rad, 3
counts and `TIMING_S` of its speed, a wheel that rolls on, too far or the wrong way does not obey: a
fault. A wheel that rolls too little, or 30 % too fast, is a warning. `sides.py` compares the two
wheels of a side. A line only adds its angles: the sides are compared after `BLOCK_S`, and the
verdicts come after steps of at least that time.

If two wheels are driven, nothing is compared on a side: a faulty encoder shows only by the command
and by a gyro.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from msgspec import Struct, field

from acsard.core.codes import Code, Reason, joined, reason
from acsard.core.config.settings import FeedbackConfig
from acsard.core.link.feedback import MAX_FILLED_GAP_S
from acsard.core.motion.gaps import plus, times
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.obedience import (
    AGREEMENT,
    DEAD_TIME_S,
    DELAYS,
    NOISE_COUNTS,
)
from acsard.core.motion.sides import (
    OUT_ANGLE,
    OUT_COUNTS,
    PARTNER_S,
    PARTNER_S_PER_RAD,
    Block,
    CommandRange,
    Side,
)
from acsard.core.motion.standstill import COMMANDED, Standstill
from acsard.core.motion.wheel import REST_S, Wheel
from acsard.core.values import (
    STILL,
    TWO_WHEELS,
    WHEELS,
    Event,
    Rad,
    RadPerS,
    Seconds,
    Wheels4,
    WheelSpeeds,
    WheelsStatus,
    wheel_names,
)

BLOCK_S = 0.05
# The longest time for which one line is evidence: the longest `mcu.reply_period`. A line may also
# cover a stall. It is as many blocks as it has times of `BLOCK_S`, or its delays were too long.
MAX_BLOCK_S = 0.25

FAULT_ANGLE, FAULT_COUNTS = 1.0, 3.0  # rad and counts, both of them, and `TIMING_S`

# The smoothed speed covers this many counts, within the longest time: a coarse encoder reports no
# motion in most lines.
SMOOTHED_COUNTS, SMOOTHED_S = 3.0, 1.0

LEAST_SPEED = 0.05  # m/s, of a runaway that must not look like rest

REPEATED_S = 1.0  # between two reports of motion without a command

SWAPPED_FRACTION = 0.2  # of the commands: by how much those of the sides must differ

# Encoder counts per turn if they are not configured: the least that acsard supports.
ASSUMED_COUNTS = 16

SIDE_OF, ACROSS = (1, 0, 0, 1), (1, 0, 3, 2)  # each wheel's side, and wheel on the other one

NOTHING: Wheels4 = (0.0, 0.0, 0.0, 0.0)


class Wheels(Struct):
    """The verdicts on the wheels. `add` takes each line; `fault`, `events`, `pushed` are of it."""

    wheels: tuple[Wheel, ...]  # four, or two
    sides: tuple[Side, Side]
    # Commanded speeds; the caller sets these three. None: the emergency stop may cut the power.
    commanded: WheelSpeeds | None = STILL
    heeded: WheelSpeeds | None = STILL  # the same at the last line
    # For which the last line does not tell what the wheels did: lines or commands are missing.
    unseen: Seconds = 0.0
    # The silence before the block, and how far and for how long its last line says they turned.
    silent_s: Seconds = 0.0
    covered: Wheels4 = NOTHING
    covered_s: Seconds = 0.0
    begins: bool = True  # the expected speeds begin at the measured ones
    angles: Wheels4 = NOTHING  # of the block, rad
    line: Wheels4 = NOTHING  # of the last line, rad
    speeds: WheelSpeeds = STILL  # in it
    turn: Rad = 0.0  # of the block by a gyro
    by_gyro: bool = True  # it is known
    seconds: Seconds = 0.0
    step_s: Seconds = 0.0  # since the last step
    lines: int = 0
    max_difference: Rad = 0.0  # of front and rear in one block, beyond which it ends early
    unreported_s: Seconds = REPEATED_S
    standstill: Standstill = field(default_factory=Standstill)
    gives_up: bool = False  # no wheel begins to move, so each sender must be neutral again
    excludes: bool = False
    slips: bool = False  # the wheels of a side contradict each other
    repair: Wheels4 = NOTHING  # what the pose still has of a wheel that is left out now, rad
    fault: Reason | None = None
    pushed: str = ""
    events: tuple[Event, ...] = ()

    def add(
        self,
        turned: Wheels4,
        speeds: WheelSpeeds,
        dt: Seconds,
        turn: Rad | None,
        feedback: FeedbackConfig,
        kinematics: Kinematics,
        count: Rad,
    ) -> None:
        """Add a line, in which the wheels turned by `turned` rad, and a trusted gyro by `turn`.

        `count` is the angle of an encoder count (`count_angle`).
        """
        self.events, self.fault, self.pushed, self.repair = (), None, "", NOTHING
        self.gives_up = False
        if self.unseen:
            # The lines before a silence are a block, and so are those behind it.
            commanded, self.commanded = self.commanded, self.heeded
            self._end_block(feedback, kinematics, count)
            self.commanded = commanded
            for side in self.sides:
                side.commands_in_silence = side.commands
            self._heed()
            self.silent_s, self.speeds = self.unseen, speeds
            self.covered, self.covered_s = times(speeds.as_tuple(), dt), dt
            return
        self.line, self.speeds = turned, speeds
        self._heed()
        front_right, front_left, rear_left, rear_right = self.angles
        first, second, third, fourth = turned
        front_right += first
        front_left += second
        rear_left += third
        rear_right += fourth
        self.angles = front_right, front_left, rear_left, rear_right
        seconds = self.seconds = self.seconds + dt
        self.lines += 1
        if turn is None:
            self.by_gyro = False
        else:
            self.turn += turn
        most = self.max_difference
        if seconds < BLOCK_S and (
            self.lines == 1
            or (-most < front_left - rear_left < most and -most < front_right - rear_right < most)
        ):
            return
        self._end_block(feedback, kinematics, count)

    def add_command(self, commanded: WheelSpeeds, s: Seconds) -> None:
        """Add what was commanded for `s` until now, with or without lines."""
        for side, speed in zip(self.sides, _of_sides(commanded), strict=True):
            side.commands = side.commands.extended(speed, s)

    def _heed(self) -> None:
        self.heeded = commanded = self.commanded
        for side, speed in zip(self.sides, _of_sides(commanded or STILL), strict=True):
            side.commands = CommandRange(speed, speed)

    def forget(self) -> None:
        """Drop the evidence of faults: one was cleared."""
        self._drop()
        for side in self.sides:
            side.forget()
        for wheel in self.wheels:
            wheel.latched = False
        self._begin()

    def believed(self, wheels: Wheels4) -> Wheels4:
        """Return angles or speeds, with the other wheel of its side for one that is left out."""
        if not self.excludes:
            return wheels
        values = list(wheels)
        for side in self.sides:
            if side.out >= 0:
                values[side.out] = wheels[side.front + side.rear - side.out]
        return _wheels4(values)

    @property
    def names(self) -> tuple[str, ...]:
        return wheel_names(len(self.wheels))

    @property
    def status(self) -> WheelsStatus:
        out = [side for side in self.sides if side.out >= 0]
        slipping = [side for side in self.sides if side.slip_s]
        texts = [side.out_text for side in out] + [side.slip_text for side in slipping]
        named = zip(self.names, self.wheels, strict=True)
        texts += [wheel.text(name) for name, wheel in named if wheel.warning]
        if self.standstill.why is not None:
            texts.append(self.standstill.why.text)
        excluded, names = [WHEELS[side.out] for side in out], [side.name for side in slipping]
        return WheelsStatus("; ".join(texts), tuple(excluded), tuple(names))

    def _begin(self) -> None:
        self.angles, self.seconds, self.lines, self.turn, self.by_gyro = NOTHING, 0.0, 0, 0.0, True
        self.silent_s = 0.0

    def _drop(self) -> None:
        self.begins = True
        for wheel in self.wheels:
            wheel.stand()
            wheel.obedience.forget()
            wheel.fast_s = wheel.fast_angle = 0.0
        self.standstill.forget()

    def _end_block(self, feedback: FeedbackConfig, kinematics: Kinematics, count: Rad) -> None:
        if feedback.encoders and (self.seconds or self.silent_s):
            self.max_difference = OUT_COUNTS * count + OUT_ANGLE
            self._judge(feedback.response_time, kinematics, count)
        self._begin()

    def _judge(self, lag: Seconds, kinematics: Kinematics, count: Rad) -> None:
        s, angles, line = self.seconds, self.angles, self.line
        if s > MAX_BLOCK_S:
            share, s = MAX_BLOCK_S / s, MAX_BLOCK_S
            angles, line = times(angles, share), times(line, share)
        rest = REST_S + 2 * count * kinematics.radius / LEAST_SPEED
        block = Block(s, angles, line, self.speeds.as_tuple(), count, rest)
        step_s = max(BLOCK_S, (max(DEAD_TIME_S, lag) - BLOCK_S / 2) / DELAYS)
        commanded = self.commanded
        if commanded is not None and self.silent_s:
            self._pass(step_s, lag, block)
        if commanded is None:
            self._drop()
            self._follow_commands(STILL, s, lag)
            self.step_s += s + self.silent_s
            # What was due before the press is still due after it: it may be a short one.
            if steps := _steps(self.step_s, step_s):
                for side in self.sides:
                    for _ in range(steps):
                        side.remember(step_s, 1.0 / step_s)
                self._begin_step()
            for wheel, angle in zip(self.wheels, angles, strict=False):
                wheel.rest(angle, block)
        elif s:
            parts = max(1, int(s / BLOCK_S + 1e-6))
            part = block._replace(s=s / parts, angles=times(angles, 1.0 / parts))
            if self.begins or self.silent_s:
                self._begin_at(part)
            for _ in range(parts):
                self._follow_commands(commanded, part.s, lag)
                self._add(part)
                if self.step_s >= step_s - 1e-9:
                    self._obey(count)
                    self._begin_step()
        if s:
            self._compare(block, kinematics)

    def _follow_commands(self, commanded: WheelSpeeds, s: Seconds, lag: Seconds) -> None:
        for side, speed in zip(self.sides, _of_sides(commanded), strict=True):
            side.expect(speed, s, lag)

    def _pass(self, step_s: Seconds, lag: Seconds, block: Block) -> None:
        # Let the time of a silence pass. The wheels may have followed the commands of this time or
        # those before it, or have stopped. If the silence is short, the slower one of the speeds
        # before and behind it is evidence.
        assert self.commanded is not None
        s, ends = self.silent_s, block.speeds
        shown_s = self.covered_s + block.s
        if shown_s:
            ends = times(plus(self.covered, block.angles), 1.0 / shown_s)
        short = s <= MAX_FILLED_GAP_S
        if self.step_s:
            s -= step_s - self.step_s
            self._obey(block.unit)
        pairs = zip(self.wheels, ends, strict=False)
        speeds = [_nearer(wheel.speed, speed) if short else 0.0 for wheel, speed in pairs]
        ranges = [side.commands_in_silence for side in self.sides]
        before = [
            (of_side.low, of_side.high, *side.smooth)
            for of_side, side in zip(ranges, self.sides, strict=True)
        ]
        if any(max(of_side.high, -of_side.low) >= COMMANDED for of_side in ranges):
            for wheel in self.wheels:
                wheel.end_rest()
        if not short:
            # Smoothing begins again.
            for side in self.sides:
                side.smooth = 0.0, 0.0, 0.0
            for wheel in self.wheels:
                wheel.stand()
        unknown = [side for side in self.sides if not any(speeds[i] for i in side.wheels)]
        for _ in range(_steps(s, step_s)):
            self._begin_step()
            self._follow_commands(self.commanded, step_s, lag)
            for i, (wheel, speed) in enumerate(zip(self.wheels, speeds, strict=True)):
                wheel.command = self.sides[SIDE_OF[i]].command
                wheel.turned = wheel.sure = speed * step_s
            self.step_s = step_s
            self._obey(block.unit, before, unknown)
        for wheel, speed in zip(self.wheels, ends, strict=False):
            if not block.s and self.covered_s >= BLOCK_S:
                # Each line ends a silence.
                share = self.covered_s / (self.covered_s + _smoothed_s(abs(speed), block.unit))
                wheel.speed = wheel.sure_speed = wheel.speed + share * (speed - wheel.speed)
        self._begin_step()

    def _begin_at(self, block: Block) -> None:
        for side in self.sides:
            speed = max(block.angles[side.front], block.angles[side.rear], key=abs) / block.s
            side.begin(speed if self.begins else _nearer(side.expected, speed))
        self.begins = False
        self._begin_step()

    def _begin_step(self) -> None:
        self.step_s = 0.0
        for wheel in self.wheels:
            wheel.turned = wheel.sure = 0.0
        for side in self.sides:
            side.angle = side.half_angle = side.whole_angle = 0.0

    def _add(self, block: Block) -> None:
        s = block.s
        self.step_s += s
        still = all(-COMMANDED < side.command < COMMANDED for side in self.sides)
        for i, wheel in enumerate(self.wheels):
            command = self.sides[SIDE_OF[i]].command
            wheel.add(block.angles[i], block.speeds[i], command, block, not still)
        self._check_standstill(block)

    def _obey(
        self,
        count: Rad,
        before: Sequence[tuple[RadPerS, ...]] = ((), ()),
        unknown: Sequence[Side] = (),
    ) -> None:
        # End a step. If it is of a silence, the wheels may have had the speeds `before`. For the
        # wheels of `unknown` sides only the time passes.
        s, fastest, least = self.step_s, 0.0, max(FAULT_ANGLE, FAULT_COUNTS * count)
        for side, speeds in zip(self.sides, before, strict=True):
            size = max(abs(side.angle) / s, *[abs(self.wheels[i].speed) for i in side.wheels])
            share = 1.0 / (_smoothed_s(size, count) + s)
            if side in unknown:
                side.remember(s, 0.0, *speeds)
                continue
            side.remember(s, share, *speeds)
            noise = NOISE_COUNTS * count * share
            bounds = side.due.bounds(noise)
            for i in side.wheels:
                self.wheels[i].follow(side, s, share, noise, bounds, least)
        for i, wheel in enumerate(self.wheels):
            if not wheel.rested:
                self._pace(i, wheel, count)
                if wheel.obedience.unexplained >= least + wheel.timing:
                    self._disobeys(i, wheel)
            elif wheel.obedience.unexplained >= least:
                fastest = max(fastest, abs(wheel.speed))
                wheel.obedience.forget()
        self.unreported_s += s
        if fastest and self.unreported_s >= REPEATED_S:
            self.unreported_s = 0.0
            self.pushed = (
                f"wheels turn at {fastest:.1f} rad/s without a command: is the robot being pushed?"
            )

    def _check_standstill(self, block: Block) -> None:
        left, right = self.sides
        angles, commands = list(block.angles[: len(self.wheels)]), (left.command, right.command)
        stood = self.standstill.why is not None
        verdict = self.standstill.add(angles, commands, block.s, block.unit)
        if verdict:
            why = self.standstill.why
            assert why is not None
            for wheel in self.wheels:
                wheel.obedience.forget()
            self.gives_up = verdict == "given up"
            if verdict == "fault":
                self.fault = why
            elif verdict == "reported" or self.gives_up:
                self.events = (*self.events, _warning(why.text, why.code))
        elif stood and self.standstill.why is None:
            self.events = (*self.events, Event("wheel_fault", "a wheel turns again", kind="again"))

    def _pace(self, i: int, wheel: Wheel, count: Rad) -> None:
        largest = self.sides[SIDE_OF[i]].due.most
        if wheel.too_fast(largest, count) and not self._latch_swapped(i):
            self._latch("wheel_too_fast", i, math.copysign(largest, wheel.speed))
        if self.standstill.why is not None:
            wheel.obedience.forget()  # one cause for all
        warning = wheel.pace(count, self.step_s)
        if not self.standstill.none_s:
            self._warn(i, wheel, warning)

    def _disobeys(self, i: int, wheel: Wheel) -> None:
        # One cause is enough: the robot stops.
        if wheel.latched or self._latch_swapped(i):
            return
        speed, command = wheel.speed, wheel.command
        due = self.sides[SIDE_OF[i]].due.in_direction_of(speed)
        against = command * speed < 0.0 and COMMANDED < abs(command) < abs(speed) / AGREEMENT
        if against and due < AGREEMENT * abs(speed):
            self._latch("wheel_reversed", i, command)
        else:
            self._latch("wheel_runaway", i, command)

    def _latch_swapped(self, i: int) -> bool:
        # Whether this wheel and the one across turn as commanded to each other.
        one, other = self.wheels[i], self.wheels[ACROSS[i]]
        command, expected = one.command - other.command, one.expected - other.expected
        if abs(command) < SWAPPED_FRACTION * max(abs(one.command), abs(other.command)):
            return False
        both = one.speed + other.speed - one.expected - other.expected
        turning = one.speed - other.speed
        # Wheels that are quicker than expected turn as commanded, but not as expected.
        if (
            abs(both) > 0.75 * abs(expected)
            or turning * expected >= -expected * expected / 2
            or turning * command >= 0
        ):
            return False
        # One cause, whichever of them shows it.
        right, left = (i, ACROSS[i]) if SIDE_OF[i] else (ACROSS[i], i)
        one, other = self.wheels[right], self.wheels[left]
        names = f"{self.names[right]} and {self.names[left]}"
        figures = (
            f"(commanded {one.command:.2f} and {other.command:.2f}, "
            f"measured {one.speed:.2f} and {other.speed:.2f} rad/s)"
        )
        self.fault = joined(reason("wheels_swapped", names, wheels=names, figures=figures))
        one.forget()
        other.forget()
        return True

    def _latch(self, code: Code, i: int, command: RadPerS) -> None:
        wheel, name = self.wheels[i], self.names[i]
        if self.fault is None:
            figures = f"(commanded {command:.2f}, measured {wheel.speed:.2f} rad/s)"
            self.fault = joined(reason(code, name, wheel=name, figures=figures))
        wheel.latched = True
        wheel.forget()

    def _warn(self, i: int, wheel: Wheel, code: Code | None) -> None:
        if code == wheel.warning:
            return
        wheel.warning = code
        if code is None:
            text = f"{self.names[i]} wheel obeys its command again"
            event = Event("wheel_fault", text, kind="again")
        else:
            event = _warning(wheel.text(self.names[i]), code)
        self.events = (*self.events, event)

    def _compare(self, block: Block, kinematics: Kinematics) -> None:
        if len(self.wheels) < len(WHEELS):
            return
        s, angles, count = block.s, block.angles, block.unit
        keep = 1.0 / (1.0 + s / (PARTNER_S + PARTNER_S_PER_RAD * count))
        left, right = self.sides
        agree = (
            left.agrees(angles[1], angles[2], keep, count),
            right.agrees(angles[0], angles[3], keep, count),
        )
        if agree == (True, True) and not self.slips:
            return
        means = (angles[1] + angles[2]) / 2, (angles[0] + angles[3]) / 2
        for k, side in enumerate(self.sides):
            low, high = sorted((side.command * s, side.expected * s))
            if self.by_gyro and agree[1 - k]:
                low = high = kinematics.opposite(*means, self.turn)[k]
            same_s = self.wheels[side.front].same_s, self.wheels[side.rear].same_s
            before, event = side.out, side.find_fault(block, agree[k], low, high, same_s)
            if before < 0 <= side.out:
                repair = list(self.repair)
                repair[side.out] = side.repair
                self.repair = _wheels4(repair)
            if event is not None:
                self.events = (*self.events, event)
        self.excludes = left.out >= 0 or right.out >= 0
        self.slips = self.excludes or left.slip_s > 0.0 or right.slip_s > 0.0


def new_wheels(independent: int) -> Wheels:
    """Return the state for four wheels, or for two, of which each is alone on its side."""
    alone = independent == len(TWO_WHEELS)
    sides = Side("left", 1, 1 if alone else 2), Side("right", 0, 0 if alone else 3)
    return Wheels(tuple([Wheel() for _ in range(independent)]), sides)


def count_angle(counts: int) -> Rad:
    """Return the angle of an encoder count; `counts` per turn are 0 if they are unknown."""
    return math.tau / (counts or ASSUMED_COUNTS)


def _smoothed_s(size: RadPerS, count: Rad) -> Seconds:
    enough = SMOOTHED_COUNTS * count
    return enough / size if size * SMOOTHED_S > enough else SMOOTHED_S


def _steps(s: Seconds, step_s: Seconds) -> int:
    return min(DELAYS + 1, int(s / step_s + 1e-6))


def _of_sides(speeds: WheelSpeeds) -> tuple[RadPerS, RadPerS]:
    return speeds.front_left, speeds.front_right


def _nearer(one: RadPerS, other: RadPerS) -> RadPerS:
    return min(one, other, key=abs) if one * other > 0.0 else 0.0


def _wheels4(values: list[float]) -> Wheels4:
    front_right, front_left, rear_left, rear_right = values
    return front_right, front_left, rear_left, rear_right


def _warning(text: str, code: Code) -> Event:
    return Event("wheel_fault", text, "warning", kind=code, code=code)
