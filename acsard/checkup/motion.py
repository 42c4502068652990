"""Evaluates the movement of the motors from the board's replies. The functions are pure.

The module also defines the speeds, rad/s, and times, s, that several steps of the check share. A
limit that only one step uses is defined in the module of that step.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from statistics import fmean

from msgspec import Struct

from acsard.core.config.wire_time import FIELD
from acsard.core.link.checked_line import Reading
from acsard.core.link.codec import Motors

# Smallest and largest measured watchdog time, s, that agrees with the firmware's `WATCHDOG_S`.
WATCHDOG_LEAST_S = 0.1  # during a longer pause of this computer, the watchdog may stop the motors
WATCHDOG_MOST_S = 0.5

# Speeds, rad/s
SPEED = 3.0  # the highest speed that the check commands: half a turn per second
RUNAWAY = 2 * SPEED  # a faster motor ends the check
MOVES = SPEED / 4  # a motor at this speed or above counts as moving
STANDING = SPEED / 10  # a motor below this speed counts as standing
# A motor that reaches this speed in a short probe counts as moving. The limit is low, because a
# heavy wheel has hardly begun to turn by then.
PROBE_MOVES = SPEED / 40

# Times, s
PERIOD_S = 0.02  # interval between two lines, unless the wire needs longer for a line
GLANCE_S = 0.2  # enough for a few replies, and for some counts of a coarse encoder
# A lifted wheel usually reaches the commanded speed, or comes to rest, within this time. If its
# speed still changes then, the check waits longer.
MOTOR_S = 2.0
# Longest wait for a speed that still changes: a heavy wheel, or a hub motor that coasts.
PATIENCE_S = 3 * MOTOR_S
BOOT_S = 3.0  # a restarted board answers by then; many bootloaders wait two seconds
CUT_S = WATCHDOG_MOST_S + GLANCE_S  # after such a silence a correct watchdog has cut the motors
# After such a silence the motors stand, unless the MCU has no watchdog.
STOOD_S = WATCHDOG_MOST_S + MOTOR_S


COUNT_S = 1.0  # a reply that is older than this does not show that a motor still turns

ZERO: Motors = (0.0, 0.0, 0.0, 0.0)

TREND_S = 0.5
"""`trend` compares the mean speeds in two intervals, each of which has at least this length, s."""

FALLS = 0.97
"""A motor counts as slowing down if `trend` returns less than this number for it. It counts as
speeding up if `trend` returns more than the inverse of this number."""


class Reply(Struct, frozen=True):
    """A valid reply of the board, with the speeds of its four motors, rad/s.

    `at_s` is the monotonic time at which the line was complete, s. `line` is its text. `reading`
    contains the board's clock and encoder counts, or is None if the line has none.
    """

    at_s: float
    motors: Motors
    line: bytes
    reading: Reading | None = None


class Step(Struct, frozen=True):
    """The interval between two replies.

    `seconds` is its duration on this computer's clock. `speeds` are the speeds in the later reply,
    rad/s. If both replies contain the board's clock and encoder counts, `mcu_s` is the duration on
    the board's clock, s, and `counts` is the number of counts by which each encoder moved, -32768
    to 32767.
    """

    seconds: float
    speeds: Motors
    mcu_s: float = 0.0
    counts: Motors | None = None


def each(value: Callable[[int], float]) -> Motors:
    """Return the tuple of `value(motor)` for the motors 0 to 3."""
    a, b, c, d = (value(motor) for motor in range(4))
    return a, b, c, d


def moving(speeds: Motors, least: float = MOVES) -> list[int]:
    """Return the numbers of the motors that turn at `least` rad/s or faster, in any direction."""
    return [motor for motor in range(4) if abs(speeds[motor]) >= least]


def since(replies: Sequence[Reply], since_s: float, until_s: float = math.inf) -> Sequence[Reply]:
    """Return the replies that arrived from `since_s` to `until_s`, s on the monotonic clock."""
    first = bisect_left(replies, since_s, key=lambda reply: reply.at_s)
    return replies[first : bisect_right(replies, until_s, key=lambda reply: reply.at_s)]


def mean(replies: Sequence[Reply]) -> Motors:
    """Return the mean of each encoder's speeds in these replies, rad/s; 0 if there are none."""
    return each(lambda motor: fmean([reply.motors[motor] for reply in replies] or [0.0]))


def steps(replies: Sequence[Reply]) -> Iterator[Step]:
    """Yield the interval from each reply to the next."""
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
    """Return the angle, rad, by which each encoder has turned since `since_s`, a monotonic time, s.

    `per_turn` is the number of encoder counts per turn. The angle is computed from the counts. If
    `per_turn` is 0, or for a reply without counts, it is computed from the speeds.
    """

    def angle(step: Step, motor: int) -> float:
        if per_turn and step.counts:
            return step.counts[motor] / per_turn * math.tau
        return step.speeds[motor] * step.seconds

    course = list(steps([Reply(since_s, ZERO, b""), *since(replies, since_s)]))
    return each(lambda motor: sum(angle(step, motor) for step in course))


def turning(replies: Sequence[Reply], now_s: float) -> list[int]:
    """Return the numbers of the motors that may still turn at the monotonic time `now_s`, s.

    A coarse encoder reports a speed of 0 in most replies, even while its motor turns. If a reply
    shows that the motor has turned by some angle, the motor therefore counts as turning for some
    time. This is the time that it would need for the same angle at the speed `STANDING`.
    """
    found: set[int] = set()
    for reply, earlier in pairwise(reversed([Reply(-math.inf, ZERO, b""), *replies])):
        ago_s = now_s - reply.at_s
        if ago_s > COUNT_S:
            break
        gap_s = min(GLANCE_S, reply.at_s - earlier.at_s)
        found.update(
            motor
            for motor in moving(reply.motors, STANDING)
            if ago_s <= abs(reply.motors[motor]) * gap_s / STANDING
        )
    return sorted(found)


def trend(replies: Sequence[Reply], now_s: float, gap_s: float) -> Motors:
    """Return for each motor the ratio of its mean speeds in two successive intervals.

    Both intervals have the same length, and the second one ends at `now_s`. The ratio is the speed
    in the second interval divided by that in the first, or 1 for a motor that stands. `gap_s` is
    the time between two replies, s.
    """
    span_s = max(TREND_S, 4 * gap_s)
    before = mean(since(replies, now_s - 2 * span_s, now_s - span_s))
    now = mean(since(replies, now_s - span_s, now_s))
    turn = [min(abs(one), abs(other)) > 0.1 for one, other in zip(before, now, strict=True)]
    return each(lambda motor: abs(now[motor] / before[motor]) if turn[motor] else 1.0)


def grain_s(steady: Sequence[Reply], motors: Sequence[int]) -> float:
    """Return the resolution of the speed readings, expressed as a time, s.

    The readings jump, because the firmware computes them from whole encoder counts. The result is
    the time in which a motor at `SPEED` turns by the angle of one jump. `steady` are replies that
    arrived while `motors` turned at this speed. The result is 0 for fewer than five replies.
    """
    if len(steady) < 5:
        return 0.0
    between_s = (steady[-1].at_s - steady[0].at_s) / (len(steady) - 1)
    speeds = [sorted(reply.motors[motor] for reply in steady) for motor in motors]
    # Ignore the extreme readings: a damaged one is not a jump.
    return max(course[-2] - course[1] for course in speeds) * between_s / SPEED


def fastest(replies: Sequence[Reply], above: float) -> tuple[int, float] | None:
    """Return the pair (motor, speed in rad/s) of a motor that surely turns faster than `above`.

    Returns None if no motor does. A single reading proves nothing: it may be damaged, or show a
    single count of a coarse encoder. The function therefore ignores the largest reading of an
    interval. It examines a short interval, which shows a runaway motor sooner, and a longer one,
    which shows it even with a coarse encoder.
    """
    for span_s in (GLANCE_S / 2, GLANCE_S) if replies else ():
        near = since(replies, replies[-1].at_s - span_s)
        course = list(steps(max(near, replies[-4:], key=len)))
        for motor in range(4):
            pieces = [(min(GLANCE_S, step.seconds), step.speeds[motor]) for step in course]
            sure = sorted(pieces, key=lambda piece: abs(piece[0] * piece[1]))[:-1]
            # After a silence, two replies may come close together. A single count in so short a
            # time would look like a high speed.
            seconds = max(GLANCE_S / 2, sum(seconds for seconds, _ in sure))
            speed = sum(seconds * speed for seconds, speed in sure) / seconds
            if abs(speed) > above:
                return motor, speed
    return None
