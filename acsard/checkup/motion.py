"""Evaluates the movement of the motors from the board's replies, without any I/O.

It has the speeds (rad/s) and times (s) that several steps share.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from itertools import pairwise
from statistics import fmean

from msgspec import Struct

from acsard.core.config.wire_time import FIELD_VALUES
from acsard.core.link.checked_line import Reading
from acsard.core.link.codec import Motors

# Shortest and longest delay after which a correct watchdog of the board stops the motors, s. The
# firmware's `WATCHDOG_S` is between these limits, which leave room for errors of the measurement.
MIN_WATCHDOG_S = 0.1
MAX_WATCHDOG_S = 0.5

# Speeds, rad/s
SPEED = 3.0  # the speed of all steps but `top_speed`: half a turn per second
RUNAWAY_SPEED = 2 * SPEED  # a faster motor ends the check
MOVING_SPEED = SPEED / 4  # a motor at this speed or above counts as moving
# Slower motors show no watchdog: 0.9 rad/s gave 0 ms for 300 ms.
TURNING_SPEED = SPEED / 3
STANDING_SPEED = SPEED / 10  # a motor below this speed counts as standing still
# A motor that reaches this mean speed in a short probe (`wheels.probe`) counts as moving. The limit
# is low, because a heavy wheel has hardly begun to turn by then.
PROBE_MOVING_SPEED = SPEED / 40

# Times, s
LINE_PERIOD_S = 0.02  # time from one line to the next, unless the wire is too slow for this
SHORT_MEASUREMENT_S = 0.2  # a short measurement: a few replies, and some counts of a coarse encoder
# A lifted wheel usually reaches the commanded speed, or comes to rest, within this time. If its
# speed still changes then, the check waits longer.
MOTOR_TIMEOUT_S = 2.0
# Longest wait for a speed that still changes: a heavy wheel, or a hub motor that coasts.
SLOWING_TIMEOUT_S = 3 * MOTOR_TIMEOUT_S
BOOT_S = 3.0  # a restarted board answers by then; many bootloaders wait two seconds
# If no line is sent for this time, a correct watchdog has switched the motors off.
WATCHDOG_SILENCE_S = MAX_WATCHDOG_S + SHORT_MEASUREMENT_S
# If no line is sent for this time, the motors stand still, unless the MCU lacks a watchdog.
STANDSTILL_TIMEOUT_S = MAX_WATCHDOG_S + MOTOR_TIMEOUT_S


# `turning` ignores replies that are older than this, s.
MAX_REPLY_AGE_S = 1.0

TREND_S = 0.5  # shortest duration of each of the two intervals whose mean speeds `trend` compares

# Below this ratio of `trend`, a motor slows down; above its inverse, it speeds up.
SLOWING_RATIO = 0.97


class BoardReply(Struct, frozen=True):
    """A valid reply: time of arrival, speeds of the motors in rad/s, and its text.

    `reading` has the board's clock and encoder counts, if the reply has them.
    """

    at_s: float
    motors: Motors
    line: bytes
    reading: Reading | None = None


class ReplyInterval(Struct, frozen=True):
    """The interval from one reply to the next: its duration by both clocks, and later speeds.

    `counts` are those by which each encoder moved, -32768 to 32767. Without the board's clock and
    counts, `mcu_s` is 0 and `counts` is None.
    """

    seconds: float
    speeds: Motors
    mcu_s: float = 0.0
    counts: Motors | None = None


def moving(speeds: Motors, least: float = MOVING_SPEED) -> list[int]:
    """Return the numbers of the motors that turn at `least` rad/s or faster, in any direction."""
    return [motor for motor, speed in enumerate(speeds) if abs(speed) >= least]


def since(
    replies: Sequence[BoardReply], since_s: float, until_s: float = math.inf
) -> Sequence[BoardReply]:
    """Return the replies that arrived between two monotonic times, s."""
    first = bisect_left(replies, since_s, key=lambda reply: reply.at_s)
    return replies[first : bisect_right(replies, until_s, key=lambda reply: reply.at_s)]


def gaps(replies: Sequence[BoardReply]) -> list[float]:
    """Return the times from each reply to the next reply, s."""
    return [after.at_s - before.at_s for before, after in pairwise(replies)]


def mean(replies: Sequence[BoardReply], zero: Motors) -> Motors:
    """Return the mean speed of each encoder in these replies, rad/s, or `zero` without replies."""
    return tuple(map(fmean, zip(*(reply.motors for reply in replies), strict=True))) or zero


def steps(replies: Sequence[BoardReply]) -> Iterator[ReplyInterval]:
    """Yield one `ReplyInterval` for each interval from a reply to the next reply."""
    for before, after in pairwise(replies):
        seconds, previous, other = after.at_s - before.at_s, before.reading, after.reading
        if previous is None or other is None:
            yield ReplyInterval(seconds, after.motors)
            continue
        pairs = zip(previous.counts, other.counts, strict=True)
        deltas = [(b - a + FIELD_VALUES // 2) % FIELD_VALUES - FIELD_VALUES // 2 for a, b in pairs]
        mcu_s = (other.mcu_ms - previous.mcu_ms) % FIELD_VALUES / 1000
        yield ReplyInterval(seconds, after.motors, mcu_s, tuple(deltas))


def covered(
    replies: Sequence[BoardReply], zero: Motors, since_s: float, per_turn: float = 0.0
) -> Motors:
    """Return the angle by which each encoder has turned since the time `since_s`, rad.

    It is that of the counts where replies have them and `per_turn` is known, else that of the
    reported speeds.
    """

    def angle(step: ReplyInterval, motor: int) -> float:
        if per_turn and step.counts:
            return step.counts[motor] / per_turn * math.tau
        return step.speeds[motor] * step.seconds

    course = list(steps([BoardReply(since_s, zero, b""), *since(replies, since_s)]))
    return tuple(sum(angle(step, motor) for step in course) for motor in range(len(zero)))


def turning(replies: Sequence[BoardReply], now_s: float) -> list[int]:
    """Return the numbers of the motors that may still turn at the time `now_s`.

    A coarse encoder reports 0 in most replies, so a motor counts as turning for some time after a
    movement.
    """
    # The motor counts as turning for the time that it would need to turn by the reported angle at
    # the speed `STANDING_SPEED`.
    motors: set[int] = set()
    for reply, earlier in pairwise(reversed([BoardReply(-math.inf, (), b""), *replies])):
        ago_s = now_s - reply.at_s
        if ago_s > MAX_REPLY_AGE_S:
            break
        gap_s = min(SHORT_MEASUREMENT_S, reply.at_s - earlier.at_s)
        motors.update(
            motor
            for motor in moving(reply.motors, STANDING_SPEED)
            if ago_s <= abs(reply.motors[motor]) * gap_s / STANDING_SPEED
        )
    return sorted(motors)


def trend(replies: Sequence[BoardReply], zero: Motors, now_s: float, gap_s: float) -> Motors:
    """Return for each motor its present mean speed divided by that shortly before.

    It is 1 for a motor that stands still. The means are over two successive intervals.
    """
    span_s = max(TREND_S, 4 * gap_s)
    before = mean(since(replies, now_s - 2 * span_s, now_s - span_s), zero)
    now = mean(since(replies, now_s - span_s, now_s), zero)
    pairs = zip(before, now, strict=True)
    return tuple(abs(b / a) if min(abs(a), abs(b)) > 0.1 else 1.0 for a, b in pairs)


def grain_s(steady: Sequence[BoardReply], motors: Sequence[int], speed: float = SPEED) -> float:
    """Return the resolution of the reported speeds as a time, s; 0 for fewer than five replies.

    Speeds jump because the firmware computes them from whole counts. It is the time in which a
    motor at `speed` turns by a jump times the time between two replies.
    """
    if len(steady) < 5:
        return 0.0
    between_s = (steady[-1].at_s - steady[0].at_s) / (len(steady) - 1)
    speeds = [sorted(reply.motors[motor] for reply in steady) for motor in motors]
    # Leave out the largest and the smallest speed, because a damaged reply may contain either.
    return max(course[-2] - course[1] for course in speeds) * between_s / speed


def runaway(replies: Sequence[BoardReply], most: float = RUNAWAY_SPEED) -> tuple[int, float] | None:
    """Return the number and speed of a motor that is faster than `most` rad/s, or None.

    It takes several replies, because one may be damaged, or show one count of a coarse encoder.
    """
    # Leave out the largest movement of each interval, which a single wrong reply can cause. A short
    # interval shows a runaway motor sooner, and a longer interval shows it even with a coarse
    # encoder.
    for span_s in (SHORT_MEASUREMENT_S / 2, SHORT_MEASUREMENT_S) if replies else ():
        near = max(since(replies, replies[-1].at_s - span_s), replies[-4:], key=len)
        # No mean of speeds in replies is above the largest one.
        fast = {motor for reply in near for motor in moving(reply.motors, most)}
        course = list(steps(near)) if fast else []
        for motor in sorted(fast):
            pieces = [
                (min(SHORT_MEASUREMENT_S, step.seconds), step.speeds[motor]) for step in course
            ]
            sure = sorted(pieces, key=lambda piece: abs(piece[0] * piece[1]))[:-1]
            # After a silence, two replies may arrive close together. A single count in such a short
            # time would look like a high speed.
            seconds = max(SHORT_MEASUREMENT_S / 2, sum(seconds for seconds, _ in sure))
            speed = sum(seconds * speed for seconds, speed in sure) / seconds
            if abs(speed) > most:
                return motor, speed
    return None
