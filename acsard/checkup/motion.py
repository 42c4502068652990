"""What replies say of the motors' movement: pure functions of their speeds and counts."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise
from statistics import fmean

from msgspec import Struct

from acsard.config.baud import FIELD
from acsard.mcu.check import Reading
from acsard.mcu.frames import Motors
from acsard.values import NS_PER_S

SPEED_S = 0.2
"""Speeds are a mean over so long: one count of a coarse encoder is no movement."""

COUNTS_S = 0.1
"""Counts tell it sooner."""

TREND_S = 0.5
"""Over so long speeds are compared with those just before."""

FALLS = 0.97
"""Below this share of what it was, a speed falls; above its inverse, it rises."""


class Reply(Struct, frozen=True):
    """A good line of the MCU, complete at `at_ns`."""

    at_ns: int
    motors: Motors
    line: bytes
    reading: Reading | None = None


def difference(before: Reading, after: Reading) -> tuple[int, ...]:
    """By how much each encoder went on, the short way round."""
    half = FIELD // 2
    pairs = zip(before.counts, after.counts, strict=True)
    return tuple((b - a + half) % FIELD - half for a, b in pairs)


def fastest(replies: Sequence[Reply], above: float, per_turn: int) -> tuple[int, float] | None:
    """A motor that surely turns faster than `above` rad/s, and its speed.

    One reading is no proof: it may be damaged, or one count of a coarse encoder. By counts, where
    the replies carry them, else by the speeds of a longer time without the highest of them.
    """
    near = replies[-64:]
    if not near:
        return None
    last_ns = near[-1].at_ns
    recent = [r for r in near if r.at_ns > last_ns - SPEED_S * NS_PER_S]
    if len(recent) < 4:
        recent = list(near[-4:])
    counted = [r for r in recent if r.reading and r.at_ns > last_ns - COUNTS_S * NS_PER_S]
    for motor in range(4):
        if max(abs(reply.motors[motor]) for reply in recent) <= above:
            continue
        mean = _mean_without_highest(recent, motor)
        speed = max(mean, _by_counts(counted, motor, per_turn), key=abs)
        if abs(speed) > above:
            return motor, speed
    return None


def _mean_without_highest(replies: Sequence[Reply], motor: int) -> float:
    """The mean over time, without the reply that adds most to it: it may be one count, or wrong."""
    ran = []
    for before, after in pairwise(replies):
        seconds = min(SPEED_S, (after.at_ns - before.at_ns) / NS_PER_S)
        ran.append((after.motors[motor] * seconds, seconds))
    ran.sort(key=lambda piece: abs(piece[0]))
    # Two quick replies after a silence: one count in so little time is no speed.
    seconds = max(SPEED_S / 2, sum(seconds for _, seconds in ran[:-1]))
    return sum(angle for angle, _ in ran[:-1]) / seconds


def _by_counts(replies: Sequence[Reply], motor: int, per_turn: int) -> float:
    """The speed by the counts from the first to the last of these, less one count; 0 if unknown."""
    if not per_turn or len(replies) < 2:
        return 0.0
    first, last = replies[0].reading, replies[-1].reading
    assert first is not None
    assert last is not None
    seconds = (last.mcu_ms - first.mcu_ms) % FIELD / 1000
    if seconds < COUNTS_S / 2:
        return 0.0
    counts = difference(first, last)[motor]
    sure = math.copysign(max(0, abs(counts) - 1), counts)
    return sure / per_turn * math.tau / seconds


def covered(replies: Sequence[Reply], since_ns: int) -> Motors:
    """By which angle each encoder went on since then, as the replies' speeds say, rad."""
    ran = [0.0] * 4
    before_ns = since_ns
    for reply in replies[bisect_right(replies, since_ns, key=lambda reply: reply.at_ns) :]:
        for motor in range(4):
            ran[motor] += reply.motors[motor] * (reply.at_ns - before_ns) / NS_PER_S
        before_ns = reply.at_ns
    a, b, c, d = ran
    return a, b, c, d


def between(replies: Sequence[Reply], since_ns: float, until_ns: float) -> Motors:
    """Each motor's mean speed, without its sign, in that time."""
    seen = [reply.motors for reply in replies if since_ns < reply.at_ns <= until_ns]
    a, b, c, d = (fmean([abs(speeds[motor]) for speeds in seen] or [0.0]) for motor in range(4))
    return a, b, c, d


def trend(replies: Sequence[Reply], now_ns: int, gap_s: float) -> Motors:
    """By which share each motor's speed is of what it was a moment before; 1 where it stands."""
    span = int(max(TREND_S, 4 * gap_s) * NS_PER_S)
    now = between(replies[-256:], now_ns - span, now_ns)
    before = between(replies[-256:], now_ns - 2 * span, now_ns - span)
    a, b, c, d = (n / b if n > 0.1 and b > 0.1 else 1.0 for n, b in zip(now, before, strict=True))
    return a, b, c, d
