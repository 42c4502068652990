"""What replies say of the motors' movement: pure functions of their speeds and counts."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from itertools import pairwise
from statistics import fmean

from msgspec import Struct

from acsard.checkup.limits import GLANCE_S
from acsard.config.wire_time import FIELD
from acsard.mcu.check import Reading
from acsard.mcu.frames import Motors

ZERO: Motors = (0.0, 0.0, 0.0, 0.0)

COUNTS_S = GLANCE_S / 2
"""Counts tell a runaway sooner than speeds do."""

TREND_S = 0.5
"""Over so long speeds are compared with those just before."""

FALLS = 0.97
"""Below this share of what it was, a speed falls; above its inverse, it rises."""

NEAR = 256
"""So many replies are a second or more."""


class Reply(Struct, frozen=True):
    """A good line of the MCU, complete at `at_s`."""

    at_s: float
    motors: Motors
    line: bytes
    reading: Reading | None = None


def each(value: Callable[[int], float]) -> Motors:
    """A value for each motor, by its number."""
    a, b, c, d = (value(motor) for motor in range(4))
    return a, b, c, d


def since(replies: Sequence[Reply], since_s: float, until_s: float = math.inf) -> Sequence[Reply]:
    """The replies from the one time to the other."""
    first = bisect_left(replies, since_s, key=lambda reply: reply.at_s)
    return replies[first : bisect_right(replies, until_s, key=lambda reply: reply.at_s)]


def mean(replies: Sequence[Reply]) -> Motors:
    """Each encoder's speed over these replies."""
    return each(lambda motor: fmean([reply.motors[motor] for reply in replies] or [0.0]))


def leg(before: Reply, after: Reply) -> tuple[Motors, float] | None:
    """By which counts each encoder went on from one reply to the other, the short way round, and
    in how many seconds, by the MCU itself; None when they do not say."""
    if before.reading is None or after.reading is None:
        return None
    ms = (after.reading.mcu_ms - before.reading.mcu_ms) % FIELD
    pairs = zip(before.reading.counts, after.reading.counts, strict=True)
    counts = [(b - a + FIELD // 2) % FIELD - FIELD // 2 for a, b in pairs]
    return each(lambda motor: counts[motor]), ms / 1000


def covered(replies: Sequence[Reply], since_s: float, per_turn: float = 0.0) -> Motors:
    """By which angle each encoder went on since then, rad.

    By the replies' speeds, or by their counts when it is said how many are a turn.
    """
    ran = [0.0] * 4
    before = Reply(since_s, ZERO, b"")
    for reply in since(replies, since_s):
        seconds = reply.at_s - before.at_s
        turned = leg(before, reply) if per_turn else None
        for motor, speed in enumerate(reply.motors):
            ran[motor] += turned[0][motor] / per_turn * math.tau if turned else speed * seconds
        before = reply
    return each(lambda motor: ran[motor])


def trend(replies: Sequence[Reply], now_s: float, gap_s: float) -> Motors:
    """By which share each motor's speed is of what it was a moment before; 1 where it stands."""
    span_s, near = max(TREND_S, 4 * gap_s), replies[-NEAR:]
    before = mean(since(near, now_s - 2 * span_s, now_s - span_s))
    now = mean(since(near, now_s - span_s, now_s))
    turn = [min(abs(one), abs(other)) > 0.1 for one, other in zip(before, now, strict=True)]
    return each(lambda motor: abs(now[motor] / before[motor]) if turn[motor] else 1.0)


def fastest(replies: Sequence[Reply], above: float, per_turn: int) -> tuple[int, float] | None:
    """A motor that surely turns faster than `above` rad/s, and its speed.

    One reading is no proof: it may be damaged, or one count of a coarse encoder. By counts, where
    the replies carry them, else by the speeds of a longer time without the highest of them.
    """
    if not replies:
        return None
    last_s = replies[-1].at_s
    recent = max(since(replies[-NEAR:], last_s - GLANCE_S), replies[-4:], key=len)
    counted = since(recent, last_s - COUNTS_S)
    for motor in range(4):
        if max(abs(reply.motors[motor]) for reply in recent) <= above:
            continue
        speeds = _mean_without_highest(recent, motor), _by_counts(counted, motor, per_turn)
        speed = max(speeds, key=abs)
        if abs(speed) > above:
            return motor, speed
    return None


def _mean_without_highest(replies: Sequence[Reply], motor: int) -> float:
    """The mean over time, without the reply that adds most to it: it may be one count, or wrong."""
    ran = []
    for before, after in pairwise(replies):
        seconds = min(GLANCE_S, after.at_s - before.at_s)
        ran.append((after.motors[motor] * seconds, seconds))
    ran.sort(key=lambda piece: abs(piece[0]))
    # Two quick replies after a silence: one count in so little time is no speed.
    seconds = max(GLANCE_S / 2, sum(seconds for _, seconds in ran[:-1]))
    return sum(angle for angle, _ in ran[:-1]) / seconds


def _by_counts(replies: Sequence[Reply], motor: int, per_turn: int) -> float:
    """The speed by the counts from the first to the last of these, less one count; 0 if unknown."""
    turned = leg(replies[0], replies[-1]) if per_turn else None
    if turned is None or turned[1] < COUNTS_S / 2:
        return 0.0
    counts, seconds = turned
    sure = math.copysign(max(0.0, abs(counts[motor]) - 1), counts[motor])
    return sure / per_turn * math.tau / seconds
