"""What a recording says of the motors' movement: pure functions of replies and their times."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from statistics import fmean

from msgspec import Struct

from acsard.checkup.limits import GLANCE_S, MOVES, SPEED
from acsard.config.wire_time import FIELD
from acsard.mcu.check import Reading
from acsard.mcu.codec import Motors

ZERO: Motors = (0.0, 0.0, 0.0, 0.0)

TREND_S = 0.5
"""Over so long speeds are compared with those just before."""

FALLS = 0.97
"""Below this share of what it was, a speed falls; above its inverse, it rises."""


class Reply(Struct, frozen=True):
    """A good line of the MCU, complete at `at_s`."""

    at_s: float
    motors: Motors
    line: bytes
    reading: Reading | None = None


class Step(Struct, frozen=True):
    """From one reply to the next: how long it took, and the speeds; where the MCU says them, how
    long it took by its own clock, and by which counts each encoder went on, the short way round."""

    seconds: float
    speeds: Motors
    mcu_s: float = 0.0
    counts: Motors | None = None


def each(value: Callable[[int], float]) -> Motors:
    """A value for each motor, by its number."""
    a, b, c, d = (value(motor) for motor in range(4))
    return a, b, c, d


def moving(speeds: Motors, least: float = MOVES) -> list[int]:
    """The motors, or encoders, that move."""
    return [motor for motor in range(4) if abs(speeds[motor]) >= least]


def since(replies: Sequence[Reply], since_s: float, until_s: float = math.inf) -> Sequence[Reply]:
    """The replies from the one time to the other."""
    first = bisect_left(replies, since_s, key=lambda reply: reply.at_s)
    return replies[first : bisect_right(replies, until_s, key=lambda reply: reply.at_s)]


def mean(replies: Sequence[Reply]) -> Motors:
    """Each encoder's speed over these replies."""
    return each(lambda motor: fmean([reply.motors[motor] for reply in replies] or [0.0]))


def steps(replies: Sequence[Reply]) -> Iterator[Step]:
    """From each reply to the next."""
    for before, after in pairwise(replies):
        seconds, one, other = after.at_s - before.at_s, before.reading, after.reading
        if one is None or other is None:
            yield Step(seconds, after.motors)
            continue
        pairs = zip(one.counts, other.counts, strict=True)
        went = [(b - a + FIELD // 2) % FIELD - FIELD // 2 for a, b in pairs]
        mcu_s = (other.mcu_ms - one.mcu_ms) % FIELD / 1000
        yield Step(seconds, after.motors, mcu_s, each(went.__getitem__))


def covered(replies: Sequence[Reply], since_s: float, per_turn: float = 0.0) -> Motors:
    """By which angle each encoder went on since then, rad.

    By the replies' speeds, or by their counts when it is said how many are a turn.
    """

    def angle(step: Step, motor: int) -> float:
        if per_turn and step.counts:
            return step.counts[motor] / per_turn * math.tau
        return step.speeds[motor] * step.seconds

    course = list(steps([Reply(since_s, ZERO, b""), *since(replies, since_s)]))
    return each(lambda motor: sum(angle(step, motor) for step in course))


def trend(replies: Sequence[Reply], now_s: float, gap_s: float) -> Motors:
    """By which share each motor's speed is of what it was a moment before; 1 where it stands."""
    span_s = max(TREND_S, 4 * gap_s)
    before = mean(since(replies, now_s - 2 * span_s, now_s - span_s))
    now = mean(since(replies, now_s - span_s, now_s))
    turn = [min(abs(one), abs(other)) > 0.1 for one, other in zip(before, now, strict=True)]
    return each(lambda motor: abs(now[motor] / before[motor]) if turn[motor] else 1.0)


def grain_s(steady: Sequence[Reply], motors: Sequence[int]) -> float:
    """For how long a steady motor turns for what its speeds jump by: whole counts make them jump,
    by one count in the time of a reply."""
    if len(steady) < 5:
        return 0.0
    between_s = (steady[-1].at_s - steady[0].at_s) / (len(steady) - 1)
    speeds = [sorted(reply.motors[motor] for reply in steady) for motor in motors]
    # One that is damaged is no jump.
    return max(course[-2] - course[1] for course in speeds) * between_s / SPEED


def fastest(replies: Sequence[Reply], above: float) -> tuple[int, float] | None:
    """A motor that surely turns faster than `above` rad/s, and its speed.

    One reading is no proof, as it may be damaged, or one count of a coarse encoder: of the last
    few steps the one that went farthest does not count. A short time tells a sudden runaway
    sooner, a longer one tells it by a coarse encoder.
    """
    for span_s in (GLANCE_S / 2, GLANCE_S) if replies else ():
        near = since(replies, replies[-1].at_s - span_s)
        course = list(steps(max(near, replies[-4:], key=len)))
        for motor in range(4):
            pieces = [(min(GLANCE_S, step.seconds), step.speeds[motor]) for step in course]
            sure = sorted(pieces, key=lambda piece: abs(piece[0] * piece[1]))[:-1]
            # Two quick replies after a silence: one count in so little time is no speed.
            seconds = max(GLANCE_S / 2, sum(seconds for seconds, _ in sure))
            speed = sum(seconds * speed for seconds, speed in sure) / seconds
            if abs(speed) > above:
                return motor, speed
    return None
