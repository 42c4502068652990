"""Decides whether each wheel obeys its command.

The expected speed is the command behind a lag of `feedback.response_time`. Measured minus expected
is summed to an angle (`Wheel.off`), which leaks only while both agree. Beyond 1 rad and 3 counts, a
wheel that came no nearer to its command for three response times does not obey it: a fault if it
rolls on, too far or the wrong way, else a warning. `sides.py` compares the two wheels of a side. A
line only adds its angles: all else runs on the sums of `BLOCK_S`.

If two wheels are driven, nothing is compared on a side: a faulty encoder shows only by the command
and by a gyro.
"""

from __future__ import annotations

import math

from msgspec import Struct

from acsard.core.codes import Code, Reason, joined, reason
from acsard.core.config.settings import FeedbackConfig
from acsard.core.motion.gaps import times
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.sides import (
    AGREEMENT,
    FAULT_RESPONSES,
    OUT_ANGLE,
    OUT_COUNTS,
    PARTNER_S,
    PARTNER_S_PER_RAD,
    Block,
    Side,
    SideName,
)
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
MAX_BLOCK_S = 0.1  # the longest time for which one line is evidence: it may cover a stall

FAULT_ANGLE, FAULT_COUNTS = 1.0, 3.0  # rad and counts, both of them
IDLE = 0.06  # counts per second of a smoothed speed that may be the rest of one count
LEAK_S = 2.0
# Largest fractions of the evidence for a fault that are kept: while both agree, and at all, because
# more would only delay the opposite one.
AGREED, MOST = 0.3, 1.2
APPROACH = 0.15  # fraction of the distance to the command that counts as coming nearer

# The smoothed speed covers this many counts, within the longest time: a coarse encoder reports no
# motion in most lines.
SMOOTHED_COUNTS, SMOOTHED_S = 3.0, 1.0

REST_S, REST_ANGLE = 0.5, 0.02  # at least, without a command: the wheel rests
LEAST_SPEED = 0.05  # m/s, of a runaway that must not look like rest

# Times the largest output of the limiter, and rad and counts rolled beyond that, both of them: a
# sound wheel shows up to a count more than it turned.
TOO_FAST, TOO_FAST_S, TOO_FAST_ANGLE, TOO_FAST_COUNTS = 1.2, 1.0, 0.3, 1.5
PACE_S = 1.5  # faster or slower by `AGREEMENT`, until this is a warning: 2 s with the smoothing
ROUNDING = 0.006  # rad/s, of a reported speed
JITTER_S = 0.004  # of the times of lines

COMMANDED = 0.005  # rad/s: a line to the board shows a lower one as 0.00

REPEATED_S = 1.0  # between two reports of motion without a command

# No wheel moves: all of them turned this fast under such a command, and at once none shows any
# motion. Motors without power slow down.
NONE_SPEED, AT_ONCE_S, NONE_S = 2.0, 0.1, 1.0

SWAPPED_FRACTION = 0.2  # of the commands: by how much those of the sides must differ

# Encoder counts per turn if they are not configured: the least that acsard supports.
ASSUMED_COUNTS = 16

SIDE_OF, ACROSS = (1, 0, 0, 1), (1, 0, 3, 2)  # each wheel's side, and wheel on the other one

NOTHING: Wheels4 = (0.0, 0.0, 0.0, 0.0)


class Wheel(Struct):
    command: RadPerS = 0.0
    speed: RadPerS = 0.0  # smoothed
    expected: RadPerS = 0.0  # smoothed alike
    off: Rad = 0.0  # the sum of measured minus expected
    agrees: bool = True
    approaches: bool = False  # in the last block
    away_s: Seconds = 0.0  # since it came nearer to its command
    away_angle: Rad = 0.0  # that it rolled since then, beyond its command
    speed_then: RadPerS = 0.0  # when it did
    command_then: RadPerS = 0.0
    reacts: bool = False  # it came nearer since the command last moved away from it
    missed: Rad = 0.0  # expected minus measured since both agreed
    rested: bool = True  # and was not commanded since then
    rest_s: Seconds = 0.0
    rest_angle: Rad = 0.0
    fast_s: Seconds = 0.0  # too fast, less the time for which it was not
    fast_angle: Rad = 0.0  # rolled beyond what the limiter allows
    pace_s: Seconds = 0.0
    pace_angle: Rad = 0.0
    doubted: bool = False  # by a latched fault, until it is cleared: the pose may have all of it
    reported: RadPerS = 0.0  # in the last line
    same_s: Seconds = 0.0  # for which it repeats this speed
    warning: Code | None = None


class Wheels(Struct):
    """The verdicts on the wheels. `add` takes each line; `fault`, `events`, `pushed` are of it."""

    wheels: tuple[Wheel, ...]  # four, or two
    sides: tuple[Side, Side]
    # Commanded speeds; the caller sets these three. None: the emergency stop may cut the power.
    commanded: WheelSpeeds | None = STILL
    late: bool = False  # this computer was late, so the board may have stopped the motors
    begins: bool = True  # the expected speeds begin at the measured ones
    angles: Wheels4 = NOTHING  # of the block, rad
    turn: Rad = 0.0  # of the block by a gyro
    by_gyro: bool = True  # it is known
    seconds: Seconds = 0.0
    lines: int = 0
    max_difference: Rad = 0.0  # of front and rear in one block, beyond which it ends early
    unreported_s: Seconds = REPEATED_S
    all_turned: bool = False  # at `NONE_SPEED` at least, until `AT_ONCE_S` before the last motion
    slow_s: Seconds = 0.0  # with any motion since then
    none_s: Seconds = 0.0  # without any
    excludes: bool = False
    slips: bool = False  # the wheels of a side contradict each other
    missed: tuple[tuple[SideName, Wheels4], ...] = ()  # by both wheels of a side
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
        self.events, self.fault, self.pushed, self.repair = (), None, "", NOTHING
        most = self.max_difference
        if seconds < BLOCK_S and (
            self.lines == 1
            or (-most < front_left - rear_left < most and -most < front_right - rear_right < most)
        ):
            return
        if feedback.encoders and seconds > 0.0:
            self.max_difference = OUT_COUNTS * count + OUT_ANGLE
            self._end_block(turned, speeds.as_tuple(), feedback.response_time, kinematics, count)
        self._begin()

    def pause(self) -> None:
        """Expect the speeds that the next lines report: there is no link."""
        self.begins = True
        self._begin()

    def forget(self) -> None:
        """Drop the evidence of faults: one was cleared."""
        self._drop()
        for wheel in self.wheels:
            wheel.doubted = False
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

    def possible_motion(self, wheels: Wheels4) -> list[tuple[SideName, Wheels4]]:
        """Return, by side, angles that may be true and that the pose leaves out, rad.

        Call this once for each line. A wheel that is left out may be blocked, or its motor may be
        reversed; two wheels of a side that do not obey may have two faulty encoders.
        """
        if not (self.excludes or self.missed):
            return []
        found, self.missed = list(self.missed), ()
        for side in self.sides:
            out, other = side.out, side.front + side.rear - side.out
            if out >= 0 and side.why != "repeats":
                values = [0.0] * 4
                values[out] = wheels[out] - wheels[other] - self.repair[out]
                found.append((side.name, _wheels4(values)))
        return found

    @property
    def names(self) -> tuple[str, ...]:
        return wheel_names(len(self.wheels))

    @property
    def status(self) -> WheelsStatus:
        out = [side for side in self.sides if side.out >= 0]
        slipping = [side for side in self.sides if side.slip_s]
        texts = [side.out_text for side in out] + [side.slip_text for side in slipping]
        named = zip(self.names, self.wheels, strict=True)
        texts += [_text(wheel, name) for name, wheel in named if wheel.warning]
        excluded, names = [WHEELS[side.out] for side in out], [side.name for side in slipping]
        return WheelsStatus("; ".join(texts), tuple(excluded), tuple(names))

    def _begin(self) -> None:
        self.angles, self.seconds, self.lines, self.turn, self.by_gyro = NOTHING, 0.0, 0, 0.0, True

    def _drop(self) -> None:
        self.begins = True
        for wheel in self.wheels:
            wheel.off = wheel.fast_s = wheel.fast_angle = wheel.missed = 0.0
            wheel.away_s = wheel.away_angle = 0.0
        self.all_turned, self.none_s = False, 0.0
        for side in self.sides:
            side.peak = side.next_peak = 0.0

    def _end_block(
        self, line: Wheels4, speeds: Wheels4, lag: Seconds, kinematics: Kinematics, count: Rad
    ) -> None:
        s, angles, commanded = self.seconds, self.angles, self.commanded
        if s > MAX_BLOCK_S:
            share, s = MAX_BLOCK_S / s, MAX_BLOCK_S
            angles, line = times(angles, share), times(line, share)
        limit, patience = max(FAULT_ANGLE, FAULT_COUNTS * count), FAULT_RESPONSES * lag
        rest = REST_S + 2 * count * kinematics.radius / LEAST_SPEED
        block = Block(s, angles, line, speeds, count, limit, patience, rest)
        if commanded is None:
            self._drop()
            for wheel, angle in zip(self.wheels, angles, strict=False):
                _rest(wheel, angle, block)
        else:
            left, right = self.sides
            left_angle = left.expect(commanded.front_left, s, lag)
            right_angle = right.expect(commanded.front_right, s, lag)
            if self.begins or self.late:
                for side in self.sides:
                    speed = max(angles[side.front], angles[side.rear], key=abs) / s
                    side.expected = speed if self.begins else _nearer(side.expected, speed)
                self.begins = False
            if not self.late:
                self._obey(block, (left_angle, right_angle))
                self._miss(block.unit, patience)
        self._compare(block, kinematics)

    def _obey(self, block: Block, expected: tuple[Rad, Rad]) -> None:
        s, angles, _, speeds, _, limit, patience, _ = block
        fastest = 0.0
        for i, wheel in enumerate(self.wheels):
            k, angle = SIDE_OF[i], angles[i]
            command = wheel.command = self.sides[k].command
            still = -COMMANDED < command < COMMANDED
            if not still:
                if wheel.rested:
                    wheel.off = wheel.missed = wheel.away_s = wheel.away_angle = 0.0
                wheel.rested, wheel.rest_s, wheel.rest_angle = False, 0.0, 0.0
            elif not wheel.rested:
                _rest(wheel, angle, block)
            _follow(wheel, angle, expected[k], block)
            if wheel.doubted and (more := expected[k] - angle):
                self._doubt(i, more)
            slack = ROUNDING * s + JITTER_S * abs(speeds[i])
            if speeds[i] == wheel.reported != 0.0 and abs(angle - speeds[i] * s) < slack:
                wheel.same_s += s
            else:
                wheel.same_s, wheel.reported = 0.0, speeds[i]
            if wheel.rested and abs(wheel.off) >= limit:
                fastest, wheel.off = max(fastest, abs(wheel.speed)), 0.0
            if not wheel.rested:
                self._pace(i, wheel, expected[k], block)
                if not wheel.agrees and abs(wheel.off) >= limit and wheel.away_s >= patience:
                    self._disobeys(i, wheel, angle, block.unit)
            if wheel.warning and wheel.agrees and not still and wheel.pace_s == 0.0:
                self._warn(i, wheel, None)
        self._find_none(block)
        self.unreported_s += s
        if fastest and self.unreported_s >= REPEATED_S:
            self.unreported_s = 0.0
            self.pushed = (
                f"wheels turn at {fastest:.1f} rad/s without a command: is the robot being pushed?"
            )

    def _find_none(self, block: Block) -> None:
        turned, least, before = list(map(abs, block.angles)), NONE_SPEED * block.s, self.none_s
        commands = [side.command for side in self.sides]
        if min(turned) >= least:
            self.all_turned, self.slow_s, self.none_s = True, 0.0, 0.0
        elif any(turned):
            self.slow_s, self.none_s = self.slow_s + block.s, 0.0
            self.all_turned = self.all_turned and self.slow_s <= AT_ONCE_S
        elif not self.all_turned or min(map(abs, commands)) < NONE_SPEED:
            self.all_turned, self.none_s = False, 0.0
        else:
            self.none_s += block.s
        if before < NONE_S <= self.none_s:
            left, right = commands
            figures = f"(commanded {left:.2f} and {right:.2f}, measured 0 rad/s)"
            self.fault = joined(reason("no_wheel_moves", seconds=NONE_S, figures=figures))

    def _pace(self, i: int, wheel: Wheel, expected: Rad, block: Block) -> None:
        s, angle, peak = block.s, block.angles[i], self.sides[SIDE_OF[i]].peak
        turns, most = abs(wheel.speed), TOO_FAST * peak
        rolled = wheel.fast_angle + angle
        beyond = abs(rolled) - most * s
        if beyond <= 0.0 or wheel.approaches or not peak:
            wheel.fast_s = wheel.fast_angle = 0.0
        else:
            wheel.fast_angle = math.copysign(beyond, rolled)
            # An encoder with few counts looks slow between two of them.
            wheel.fast_s = max(0.0, wheel.fast_s + (s if turns > most else -s))
            enough = max(TOO_FAST_ANGLE, TOO_FAST_COUNTS * block.unit)
            if wheel.fast_s >= TOO_FAST_S and beyond >= enough:
                self._latch("wheel_too_fast", i, peak)
        # Quick or slow motors differ from what is expected after a change of the command.
        steady = abs(wheel.expected - wheel.command) < AGREEMENT * abs(wheel.command)
        if not wheel.agrees and steady:
            wheel.pace_s += s
            wheel.pace_angle += angle - expected
            if wheel.pace_s >= PACE_S and abs(wheel.pace_angle) >= block.unit:
                fast = turns > abs(wheel.expected)
                self._warn(i, wheel, wheel.warning or ("wheel_fast" if fast else "wheel_slow"))
        elif wheel.pace_s:
            wheel.pace_s -= s
            if wheel.pace_s <= 0.0:
                wheel.pace_s = wheel.pace_angle = 0.0

    def _disobeys(self, i: int, wheel: Wheel, angle: Rad, count: Rad) -> None:
        speed, off, command = wheel.speed, wheel.off, wheel.command
        if self._are_swapped(i):
            return
        goes_on = angle * off > 0.0 and speed * off > 0.0
        beyond = abs(wheel.away_angle)
        if goes_on and abs(command) < COMMANDED:
            # A sound wheel comes to rest before it has rolled this far without an approach.
            if beyond >= max(FAULT_ANGLE, FAULT_COUNTS * count):
                self._latch("wheel_runaway", i, command)
        elif goes_on and off * command > 0.0:
            # A sound wheel is at its command before its smoothed speed, the mean of some counts.
            if beyond >= count and abs(speed) > abs(command):
                self._latch("wheel_runaway", i, command)
        elif goes_on and abs(speed) >= AGREEMENT * abs(command):
            self._latch("wheel_reversed", i, command)
        elif off * command < 0.0 and abs(speed) < AGREEMENT * abs(command) and not self.none_s:
            self._warn(i, wheel, "wheel_blocked")

    def _are_swapped(self, i: int) -> bool:
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
        self.fault = joined(reason("wheels_swapped", part=names, wheels=names, figures=figures))
        return True

    def _latch(self, code: Code, i: int, command: RadPerS) -> None:
        wheel, name = self.wheels[i], self.names[i]
        if self.fault is None:
            figures = f"(commanded {command:.2f}, measured {wheel.speed:.2f} rad/s)"
            self.fault = joined(reason(code, part=name, wheel=name, figures=figures))
        if not wheel.doubted:
            wheel.doubted = True
            self._doubt(i, wheel.missed)
        # Another fault needs new evidence: the robot stops now.
        wheel.off = wheel.away_s = wheel.away_angle = wheel.fast_s = wheel.fast_angle = 0.0

    def _doubt(self, i: int, angle: Rad) -> None:
        # What a wheel with a latched fault showed otherwise than expected, which the pose has. Of
        # a wheel that is left out the pose has nothing, and `possible_motion` covers it.
        if self.sides[SIDE_OF[i]].out == i:
            return
        values = [0.0] * 4
        values[i] = angle
        if len(self.wheels) < len(WHEELS):
            values[3 - i] = angle
        self.missed = (*self.missed, (self.sides[SIDE_OF[i]].name, _wheels4(values)))

    def _warn(self, i: int, wheel: Wheel, code: Code | None) -> None:
        if code == wheel.warning:
            return
        wheel.warning = code
        if code is None:
            text = f"{self.names[i]} wheel obeys its command again"
            event = Event("wheel_fault", text, kind="again")
        else:
            text = _text(wheel, self.names[i])
            event = Event("wheel_fault", text, "warning", kind=code, code=code)
        self.events = (*self.events, event)

    def _miss(self, count: Rad, patience: Seconds) -> None:
        for side in self.sides:
            one, other = self.wheels[side.front], self.wheels[side.rear]
            # Quick motors stop before they are expected to.
            still = -COMMANDED < side.command < COMMANDED
            if side.out >= 0 or still or min(abs(one.missed), abs(other.missed)) <= count:
                continue
            if one.away_s >= patience and other.away_s >= patience:
                values = [0.0] * 4
                values[side.front], values[3 - side.front] = one.missed, other.missed
                one.missed = other.missed = 0.0
                self.missed = (*self.missed, (side.name, _wheels4(values)))

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


def _follow(wheel: Wheel, angle: Rad, expected_angle: Rad, block: Block) -> None:
    s, count, command, speed = block.s, block.unit, wheel.command, wheel.speed
    size = command if command > 0.0 else -command
    turns = speed if speed > 0.0 else -speed
    most = turns if turns > size else size
    smoothed = SMOOTHED_S
    if most * SMOOTHED_S > SMOOTHED_COUNTS * count:
        smoothed = SMOOTHED_COUNTS * count / most
    share = 1.0 / (smoothed + s)
    speed = wheel.speed = speed + (angle - speed * s) * share
    expected = wheel.expected = wheel.expected + (expected_angle - wheel.expected * s) * share
    turns = speed if speed > 0.0 else -speed
    difference = abs(speed - expected)
    off, most = wheel.off + angle - expected_angle, MOST * block.limit
    agrees = wheel.agrees = (
        difference <= AGREEMENT * max(turns, abs(expected)) or difference < IDLE * count
    )
    if agrees:
        off -= off * s / LEAK_S
        most = AGREED * block.limit
        wheel.missed = 0.0
    else:
        wheel.missed += expected_angle - angle
    wheel.off = most if off > most else -most if off < -most else off
    away = speed - command
    nearer, farther = wheel.speed_then - speed, wheel.command_then - command
    if away < 0.0:
        away, nearer, farther = -away, -nearer, -farther
    approaches = wheel.approaches = nearer > APPROACH * away + 2 * count * share
    if away <= AGREEMENT * max(turns, size) or farther > AGREEMENT * away:
        wheel.away_s, wheel.away_angle = 0.0, 0.0
        wheel.speed_then, wheel.command_then, wheel.reacts = speed, command, False
    elif approaches:
        wheel.away_s, wheel.away_angle, wheel.speed_then, wheel.reacts = 0.0, 0.0, speed, True
    else:
        wheel.away_s += s
        wheel.away_angle += angle - command * s
        if nearer < 0.0 and not wheel.reacts:
            wheel.speed_then = speed  # the worst one counts


def _rest(wheel: Wheel, angle: Rad, block: Block) -> None:
    wheel.rest_angle += angle
    wheel.rest_s += block.s
    if abs(wheel.rest_angle) > 1.01 * block.unit + REST_ANGLE:
        wheel.rest_s = wheel.rest_angle = 0.0
    elif wheel.rest_s >= block.rest:
        wheel.rested, wheel.rest_s, wheel.rest_angle, wheel.off = True, 0.0, 0.0, 0.0


def _nearer(one: RadPerS, other: RadPerS) -> RadPerS:
    return min(one, other, key=abs) if one * other > 0.0 else 0.0


def _wheels4(values: list[float]) -> Wheels4:
    front_right, front_left, rear_left, rear_right = values
    return front_right, front_left, rear_left, rear_right


def _text(wheel: Wheel, name: str) -> str:
    assert wheel.warning is not None
    share = wheel.speed / wheel.expected if wheel.expected else 0.0
    return joined(reason(wheel.warning, wheel=name, share=f"{share:.0%}")).text
