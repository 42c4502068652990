"""Tests of the conclusions about movement that follow from replies."""

from __future__ import annotations

import math

import pytest

from acsard.checkup import motion
from acsard.checkup.motion import BoardReply
from acsard.core.link.checked_line import Reading


def course(
    speed: float, per_turn: int, period_ms: int = 20, seconds: float = 1.0, sampled: bool = False
) -> list[BoardReply]:
    """Return replies in which the speed of motor b follows from its whole counts."""
    series, before = [], 0
    for n in range(1, int(seconds * 1000 / period_ms)):
        counts = math.floor(speed * n * period_ms / 1000 / math.tau * per_turn)
        velocity = (counts - before) / per_turn * math.tau / period_ms * 1000
        reading = Reading(n * period_ms, (0, counts % 65536, 0, 0)) if sampled else None
        series.append(BoardReply(n * period_ms / 1000, (0.0, velocity, 0.0, 0.0), b"", reading))
        before = counts
    return series


@pytest.mark.variations(4)
@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize("per_turn", [16, 24, 48, 64, 96, 3200])
@pytest.mark.parametrize("period_ms", [10, 20, 100])
def test_a_coarse_encoder_is_not_a_runaway_but_a_real_runaway_is_found(
    sampled: bool, per_turn: int, period_ms: int
) -> None:
    for speed in (3.0, -3.0):
        good = course(speed, per_turn, period_ms, 3.0, sampled)
        for n in range(1, len(good)):
            assert motion.runaway(good[:n]) is None
    runaway = motion.runaway(course(-9.0, per_turn, period_ms, 1.0, sampled))
    assert runaway is not None
    assert runaway[0] == 1
    assert -10.0 < runaway[1] < -6.0


@pytest.mark.parametrize("sampled", [False, True])
def test_a_sudden_runaway_is_found_by_its_third_reply(sampled: bool) -> None:
    replies = course(1.0, 3200, 20, 1.0, sampled)
    for _ in range(3):
        assert motion.runaway(replies) is None
        last = replies[-1]
        counts = (0, last.reading.counts[1] + 200, 0, 0) if last.reading else (0, 0, 0, 0)
        reading = last.reading and Reading(last.reading.mcu_ms + 20, counts)
        replies.append(BoardReply(last.at_s + 0.02, (0.0, 19.6, 0.0, 0.0), b"", reading))
    assert motion.runaway(replies) is not None


def test_without_replies_there_is_no_runaway_no_angle_and_no_trend() -> None:
    assert motion.runaway([]) is None
    assert motion.covered([], 0) == (0.0,) * 4
    assert motion.trend([], 0, 0.02) == (1.0,) * 4


@pytest.mark.parametrize("per_turn", [24, 3200])
def test_the_covered_angle_is_the_sum_of_the_speeds_over_time(per_turn: int) -> None:
    replies = course(3.0, per_turn)
    assert motion.covered(replies, 0)[1] == pytest.approx(2.94, abs=math.tau / per_turn)
    assert motion.covered(replies, 0.5)[1] == pytest.approx(1.44, abs=2 * math.tau / per_turn)


def test_a_trend_is_the_ratio_to_the_earlier_speed() -> None:
    speeds = [3.0 * 0.99**n for n in range(100)]
    replies = [BoardReply(n * 0.02, (0.0, -s, 3.0, 0.0), b"") for n, s in enumerate(speeds)]
    a, b, c, d = motion.trend(replies, replies[-1].at_s, 0.02)
    assert (a, c, d) == (1.0, 1.0, 1.0)
    assert b == pytest.approx(0.99**25, rel=0.01)


@pytest.mark.parametrize("per_turn", [16, 48, 400, 3200])
def test_a_motor_between_two_counts_turns_and_a_silent_one_stands(per_turn: int) -> None:
    replies = course(0.6, per_turn, seconds=3.0)
    first = next(n for n, reply in enumerate(replies) if reply.motors[1])
    for n in range(first + 1, len(replies)):
        assert motion.turning(replies[:n], replies[n - 1].at_s) == [1]
    end_s = replies[-1].at_s
    assert motion.turning(replies, end_s + motion.MAX_REPLY_AGE_S + 0.01) == []
    assert motion.turning([], end_s) == []
