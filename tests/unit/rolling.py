"""Simulated robots of any size that drive at random, and report what their encoders count.

The product's limiter and kinematics give the commands, and its simulator the motors and encoders.
An hour of a whole daemon takes ten times as long, so what a `FakeMcu` has not is here: motors and
tyres that differ from wheel to wheel, rough ground, a dead time, and motors that coast. The seed
determines all that a robot does.
"""

from __future__ import annotations

import math
import random
from collections import deque
from typing import Literal

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.settings import DriveConfig, FeedbackConfig, LimitsConfig, WheelMap
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.limits import follow
from acsard.core.motion.obedience import DEAD_TIME_S
from acsard.core.motion.wheel import TIMING_S
from acsard.core.motion.wheels import (
    FAULT_ANGLE,
    FAULT_COUNTS,
    Wheels,
    count_angle,
    new_wheels,
)
from acsard.core.simulator.vehicle import approach
from acsard.core.values import WHEELS, Motion, Twist, Wheels4, WheelSpeeds
from tests.wheels import FOUR

Kind = Literal["reversed", "runaway", "dead", "stuck", "swapped", "too fast", "too slow"]

COUNTS = 16, 24, 48, 96, 400, 1024, 3200

FACTORS = {"too fast": (1.6, 2.5), "too slow": (0.35, 0.55)}

# The codes that name each fault. A wheel with a stuck encoder looks as if it did not obey.
RIGHT: dict[Kind, set[str]] = {
    "reversed": {"wheel_reversed", "left out"},
    "runaway": {"wheel_runaway"},
    "dead": {"wheel_blocked", "left out", "no_wheel_begins"},
    "stuck": {
        "wheel_runaway", "wheel_too_fast", "wheel_reversed", "wheel_blocked",
        "wheel_slow", "left out",
    },
    "swapped": {"wheels_swapped"},
    "too fast": {"wheel_too_fast", "wheel_runaway", "wheel_fast"},
    "too slow": {"wheel_slow", "wheel_blocked"},
}  # fmt: skip


# Of the evidence for a fault, and of the way in the time by which a motion may be later than a
# delay: what the wheels roll at most until a fault is found.
ANGLES: dict[Kind, float] = {
    "reversed": 1.8, "stuck": 1.2, "swapped": 2.6, "too fast": 4.0, "runaway": 3.0, "dead": 2.6,
    "too slow": 4.0,
}  # fmt: skip


class Robot(Struct, frozen=True):
    """A robot: its size, its encoders, its motors, and what the configuration says of them."""

    radius: float
    track: float
    counts: int
    declared: bool
    lag: float
    response_time: float
    rate: float
    speed: float  # m/s, at which it drives

    @property
    def drive(self) -> DriveConfig:
        return DriveConfig(wheel_radius=self.radius, wheel_separation=self.track)

    @property
    def limits(self) -> LimitsConfig:
        return LimitsConfig(wheel_speed=min(90.0, 3.0 / self.radius))


def robot(dice: random.Random, sound: bool = True) -> Robot:
    radius = math.exp(dice.uniform(math.log(0.03), math.log(0.2)))
    lag = math.exp(dice.uniform(math.log(0.05), math.log(1.5 if sound else 0.3)))
    known = lag * dice.uniform(0.75, 1.33)
    return Robot(
        radius,
        radius * dice.uniform(4.0, 8.0),
        dice.choice(COUNTS),
        dice.random() < 0.5,
        lag,
        0.2 if lag < 0.3 else known,
        dice.choice((50.0, 100.0)),
        math.exp(dice.uniform(math.log(0.05), 0.0)),
    )


class Findings(Struct):
    """What `Wheels` said: the first time of each code, the latched faults, and the reports."""

    first: dict[str, float] = {}
    faults: list[str] = []
    pushes: int = 0
    excluded: set[str] = set()


class Bench:
    """One robot with its `Wheels`, step by step. On a rough ground no step is like the last one."""

    def __init__(
        self, robot: Robot, dice: random.Random, rough: bool = True, wheels: WheelMap = FOUR
    ) -> None:
        self.robot, self.dice, self.rough, self.driven = robot, dice, rough, len(wheels.names)
        self.kinematics = Kinematics(robot.drive)
        self.limits = robot.limits
        self.feedback = FeedbackConfig(response_time=robot.response_time)
        self.count = count_angle(robot.counts if robot.declared else 0)
        self.unit = math.tau / robot.counts
        self.wheels: Wheels = new_wheels(self.driven)
        self.motion = Motion()
        self.now = 0.0
        self.speeds = [0.0] * self.driven
        self.angles = [dice.uniform(0.0, self.unit) for _ in self.speeds]
        self.counted = [math.floor(angle / math.tau * robot.counts) for angle in self.angles]
        self.lags = [robot.lag * dice.uniform(0.9, 1.1) for _ in self.speeds]
        self.sizes = [dice.uniform(0.985, 1.015) for _ in self.speeds]
        self.gain = 1.0  # slopes and bumps
        self.hand: list[float] | None = None  # rad/s of each wheel that a person turns
        self.drives: dict[int, float] = {}  # factor of the command of a motor
        self.keeps: set[int] = set()  # motors that keep their speed
        self.swaps: list[tuple[int, int]] = []
        self.dead: set[int] = set()  # encoders
        self.signs: dict[int, int] = {}  # of encoders
        self.frozen: dict[int, float] = {}  # encoders that repeat a speed
        self.slips: dict[int, float] = {}  # factor of the motion of a wheel
        self.said = Findings()
        self.cap = math.inf
        self.late: deque[list[float]] = deque()  # commands that the motors do not see yet
        self.coasts = 1.0  # how much slower motors slow down than they speed up
        self.linked = True
        self.unseen, self.missed = 0.0, [0.0] * self.driven  # s and rad since the last line
        self.excess = 0.0  # m that the motors which keep their speed rolled beyond their command

    def step(self, wished: Twist) -> None:
        dt = 1.0 / self.robot.rate
        self.now += dt
        self.motion = (
            follow(self.motion, wished, dt, self.limits, self.kinematics, self.cap)
            if self.linked
            else Motion()
        )
        commanded = self.kinematics.wheel_speeds(self.motion.twist)
        told = list(commanded.as_tuple()[: self.driven])
        self.late.append(list(told))
        goals = self.late.popleft()
        for i, j in self.swaps:
            goals[i], goals[j] = goals[j], goals[i]
        turned, speeds = [0.0] * self.driven, [0.0] * self.driven
        for i, goal in enumerate(goals):
            lag, goal = self.lags[i], goal * self.gain * self.sizes[i] * self.drives.get(i, 1.0)
            if self.hand is not None:
                goal, lag = self.hand[i], 0.1
            before = self.speeds[i]
            if self.hand is None and abs(goal) < abs(before) and goal * before >= 0.0:
                lag *= self.coasts
            goal *= self.dice.uniform(0.98, 1.02) if self.rough else 1.0
            if i in self.keeps:
                goal = before
            self.speeds[i], moved = approach(before, goal, dt, lag)
            moved *= self.slips.get(i, 1.0)
            moved *= self.dice.uniform(0.95, 1.05) if self.rough else 1.0
            self.angles[i] += moved
            if i in self.keeps:
                self.excess += (moved - told[i] * dt) * self.robot.radius / len(self.keeps)
            counted = math.floor(self.angles[i] / math.tau * self.robot.counts)
            counts, self.counted[i] = counted - self.counted[i], counted
            counts = 0 if i in self.dead else counts * self.signs.get(i, 1)
            speeds[i] = self.frozen.get(i, round(counts * self.unit / dt, 2))
            turned[i] = speeds[i] * dt
        self.missed = [a + b for a, b in zip(self.missed, turned, strict=True)]
        if not self.linked:
            self.unseen += dt
            return
        # A line that ends a silence has the counts of all of it.
        turned, passed = self.missed, self.unseen + dt
        reported = WheelSpeeds(*of_four(speeds))
        wheels, said = self.wheels, self.said
        wheels.commanded, wheels.unseen = commanded, passed if self.unseen else 0.0
        self.unseen, self.missed = 0.0, [0.0] * self.driven
        wheels.add(
            of_four(turned), reported, passed, None, self.feedback, self.kinematics, self.count,
        )  # fmt: skip
        for event in wheels.events:
            said.first.setdefault(event.code or event.kind, self.now)
        if wheels.fault is not None:
            said.first.setdefault(wheels.fault.code, self.now)
            said.faults.append(wheels.fault.code)
        said.pushes += bool(wheels.pushed)
        said.excluded.update(WHEELS[side.out] for side in wheels.sides if side.out >= 0)

    def hold(self, wished: Twist, seconds: float) -> None:
        for _ in range(max(1, round(seconds * self.robot.rate))):
            self.step(wished)


def of_four(values: list[float]) -> Wheels4:
    """Return the values of four wheels; of two driven ones, the rear ones do as the front ones."""
    right, left, *rear = values
    rear_left, rear_right = rear or (left, right)
    return right, left, rear_left, rear_right


def twist(dice: random.Random, made: Robot) -> Twist:
    kind, speed = dice.random(), made.speed
    turn = 2.0 * speed / made.track * dice.uniform(-1.0, 1.0)
    if kind < 0.25:
        return Twist(dice.choice((-1, 1)) * speed)
    if kind < 0.45:
        return Twist(0.0, turn)
    if kind < 0.6:
        return Twist()
    return Twist(speed * dice.uniform(-1.0, 1.0), turn * dice.uniform(0.0, 1.0))


def sound(seed: int, seconds: float, wheels: WheelMap) -> tuple[Robot, Findings]:
    """Drive a sound robot at random: slopes, bumps, reversals, caps, and pushes while it rests."""
    dice = random.Random(seed)
    made = robot(dice)
    bench = Bench(made, dice, wheels=wheels)
    while bench.now < seconds:
        slope = dice.uniform(0.75, 1.15)
        bench.cap = made.speed * dice.uniform(0.2, 1.0) if dice.random() < 0.2 else math.inf
        wished, until = twist(dice, made), bench.now + dice.uniform(0.2, 5.0)
        while bench.now < until:
            bench.gain = slope
            if dice.random() < 0.02:
                bench.gain = slope * dice.uniform(0.6, 1.4)
            bench.hold(wished, min(dice.uniform(0.1, 0.3), until - bench.now))
        if dice.random() < 0.1:
            rest = 3.0 + 6.0 * made.lag
            bench.hold(Twist(), rest + made.speed)
            ahead, turning = dice.uniform(-1, 1), dice.choice((0.0, dice.uniform(-1, 1)))
            pushed = bench.kinematics.wheel_speeds(Twist(ahead, turning / made.track))
            bench.hand = list(pushed.as_tuple())
            bench.hold(Twist(), dice.uniform(0.5, 4.0))
            bench.hand = [0.0] * 4
            bench.hold(Twist(), 2.5)
            bench.hand = None
    return made, bench.said


def swing(bench: Bench, dice: random.Random, one: Twist, other: Twist, each: float) -> None:
    """Move the stick between two wishes for a while, on one slope, sometimes below a cap."""
    until, slope = bench.now + dice.uniform(2.0, 20.0), dice.uniform(0.75, 1.15)
    bench.cap = bench.robot.speed * dice.uniform(0.2, 1.0) if dice.random() < 0.2 else math.inf
    while bench.now < until:
        bench.gain = min(1.15, slope * (dice.uniform(0.6, 1.1) if dice.random() < 0.1 else 1.0))
        bench.hold(one, each * dice.uniform(0.5, 1.5))
        bench.hold(other, each * dice.uniform(0.5, 1.5))


def restless(seed: int, seconds: float, wheels: WheelMap) -> tuple[Robot, Findings]:
    """Drive a sound robot whose stick moves to and fro between two wishes, on slopes."""
    dice = random.Random(seed)
    made = robot(dice)
    bench = Bench(made, dice, wheels=wheels)
    while bench.now < seconds:
        one, other = twist(dice, made), twist(dice, made)
        if dice.random() < 0.5:
            other = Twist(one.linear * dice.uniform(-1, 1), one.angular * dice.uniform(-1, 1))
        swing(bench, dice, one, other, dice.uniform(0.1, 2.5))
    return made, bench.said


def overdue(seed: int, seconds: float, wheels: WheelMap) -> tuple[Robot, Findings]:
    """Drive a sound robot with a dead time, or one that coasts, that the configuration ignores."""
    dice = random.Random(f"overdue {seed}")
    made = robot(dice)
    dead, coasts = (dice.uniform(0.05, 0.6), 1.0) if seed % 2 else (0.0, dice.uniform(1.5, 6.0))
    if dead and made.lag > 0.3:
        made = replace(made, lag=dice.uniform(0.05, 0.25), response_time=0.2)
    bench = Bench(made, dice, wheels=wheels)
    bench.late.extend([[0.0] * bench.driven] * round(dead * made.rate))
    longest = 1.2 if made.counts >= 100 and made.declared else 0.8
    bench.coasts = min(coasts, max(1.0, max(longest, 2.0 * made.response_time) / made.lag))
    bench.limits = brisk(bench.limits, dice.choice((1.0, 1.0, 3.0)))
    while bench.now < seconds:
        one, other = twist(dice, made), twist(dice, made)
        if dice.random() < 0.5:
            other = Twist(one.linear * dice.uniform(-1, 1), one.angular * dice.uniform(-1, 1))
        each = dice.choice((dice.uniform(0.1, 2.5), dice.uniform(0.2, 5.0)))
        swing(bench, dice, one, other, each)
    return made, bench.said


def brisk(limits: LimitsConfig, acceleration: float) -> LimitsConfig:
    a = acceleration
    return replace(
        limits, linear_acceleration=a, linear_deceleration=a, angular_acceleration=4 * a,
        angular_deceleration=4 * a, linear_stop_deceleration=3.0, angular_stop_deceleration=12.0,
    )  # fmt: skip


FLICKER_S, FLICKERS_S = 0.13, 0.4  # the link is lost for so long, and so often


def to_and_fro(seed: int, wheels: WheelMap, flickers: bool) -> tuple[Robot, Bench]:
    """Motors keep one speed while the stick moves between two wishes, for a minute or 8 m.

    The mean of the wishes differs from that speed by a fifth or more.
    """
    dice = random.Random(f"to and fro {seed}")
    speed = dice.uniform(0.2, 1.0)
    made = replace(robot(dice, sound=False), speed=speed)
    bench = Bench(made, dice, wheels=wheels)
    bench.limits = brisk(bench.limits, dice.choice((1.0, 1.0, 3.0)))
    one = other = (0.0, 0.0)
    mean = speed
    while abs(speed - mean) < 0.2 * speed:
        pair = dice.choice(
            ((1.0, 0.0), (1.0, -1.0), (1.0, 0.4), (1.0, -0.5), (0.6, -0.2), (dice.random(), -1.0))
        )
        top = dice.uniform(0.5, 1.3) * speed
        times = [math.exp(dice.uniform(math.log(0.2), math.log(3.0))) for _ in pair]
        one, other = (top * pair[0], times[0]), (top * pair[1], times[1])
        mean = (one[0] * one[1] + other[0] * other[1]) / sum(times)
    bench.hold(Twist(), 1.0)
    bench.hold(Twist(speed), 3.0 + speed)
    groups = GROUPS[bench.driven]
    bench.keeps, bench.said = set(groups[seed % len(groups)]), Findings()
    began = bench.now
    while not bench.said.faults and bench.now < began + 60.0 and abs(bench.excess) < 8.0:
        for wish, seconds in (one, other):
            until = bench.now + seconds
            while bench.now < until and not bench.said.faults:
                bench.linked = not flickers or (bench.now - began) % FLICKERS_S >= FLICKER_S
                bench.step(Twist(wish))
    return made, bench


class Case(Struct, frozen=True):
    robot: Robot
    kind: Kind
    wheels: tuple[int, ...]
    found: str  # the first right code, "" if it was not found
    said: dict[str, float]
    late: float  # rad beyond the bound that the faulty wheels have rolled when it was found


GROUPS: dict[int, tuple[tuple[int, ...], ...]] = {
    4: ((0,), (1,), (2,), (3,), (0, 3), (1, 2), (0, 1, 2, 3)),
    2: ((0,), (1,), (0, 1)),
}


def faulty(kind: Kind, seed: int, wheels: WheelMap) -> Case:
    """Drive a robot that has a fault, until it is found or the bound has passed by far."""
    dice = random.Random(f"{kind} {seed}")
    made = robot(dice, sound=False)
    bench = Bench(made, dice, wheels=wheels)
    groups = GROUPS[bench.driven]
    group = groups[seed % len(groups)]
    speed = made.speed * dice.choice((-1, 1))
    arc = Twist(speed, dice.choice((0.0, dice.uniform(-0.5, 0.5) * speed / made.track)))
    wished = arc
    if kind == "swapped":
        pairs = dice.choice([[(0, 1)], [(3, 2)], [(0, 1), (3, 2)]][: bench.driven - 1])
        bench.swaps = pairs
        group = tuple(i for pair in pairs for i in pair)
        turn = dice.choice((-1, 1)) * dice.uniform(0.6, 2.0) * abs(speed) / made.track
        wished = Twist(speed * dice.choice((0.0, 0.5)), turn)
    motors = kind in ("runaway", "too fast", "too slow") or dice.random() < 0.5
    for i in group:
        if kind == "reversed":
            if motors:
                bench.drives[i] = -1.0
            else:
                bench.signs[i] = -1
        elif kind == "dead":
            if motors:
                bench.drives[i] = 0.0
            else:
                bench.dead.add(i)
        elif kind in FACTORS:
            bench.drives[i] = dice.uniform(*FACTORS[kind])
    bench.hold(Twist(), 1.0)
    if kind in ("runaway", "stuck"):
        # The fault begins in motion; then the robot stops, or turns around.
        bench.hold(arc, 3.0 + abs(speed) / bench.limits.linear_acceleration)
        if kind == "runaway":
            bench.keeps = set(group)
        else:
            bench.frozen = {i: round(bench.speeds[i], 2) for i in group}
        wished = Twist() if kind == "runaway" else Twist(-0.5 * speed)
    bench.said = Findings()
    start, right = bench.now, RIGHT[kind]
    ramp = _ramp(bench, wished)
    patience = 2.0 if kind in FACTORS else max(DEAD_TIME_S, 3.0 * made.response_time)
    bench.hold(wished, ramp + patience)
    limit = max(FAULT_ANGLE, FAULT_COUNTS * max(bench.unit, bench.count))
    limit = ANGLES[kind] * (limit + TIMING_S * abs(speed) / made.radius)
    commanded = bench.kinematics.wheel_speeds(bench.motion.twist).as_tuple()
    began, needs = bench.now, 0.0
    found = ""
    while not found and bench.now < began + 60.0:
        found = next((code for code in bench.said.first if code in right), "")
        if found:
            break
        before = list(bench.angles)
        bench.step(wished)
        # What the wheels or their encoders show, or ought to show.
        needs += min(
            max(abs(bench.angles[i] - before[i]), abs(commanded[i]) / made.rate) for i in group
        )
    said = {code: when - start for code, when in bench.said.first.items()}
    return Case(made, kind, group, found, said, needs - limit)


def _ramp(bench: Bench, wished: Twist) -> float:
    limits, now = bench.limits, bench.motion.twist
    linear = min(limits.linear_acceleration, limits.linear_deceleration)
    angular = min(limits.angular_acceleration, limits.angular_deceleration)
    change = abs(wished.linear - now.linear) / linear
    return max(change, abs(wished.angular - now.angular) / angular)
