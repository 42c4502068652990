"""Jerk limits only how fast the robot speeds up."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.settings import LimitsConfig
from acsard.core.values import REST, Twist
from tests.each import each
from tests.unit.test_drive_limits import (
    DT,
    EPS,
    JERKY,
    Pair,
    Ramp,
    law,
    millimetres,
    mixed,
    moving,
    near,
    pair,
)


def test_jerk_takes_the_time_worked_by_hand_and_never_delays_braking() -> None:
    # The slope rises to 1 m/s2 in 20 steps of 0.05 m/s2, which covers 0.105 m/s. It falls in 19
    # steps, which covers 0.095 m/s. The 0.3 m/s in between take 30 steps of 10 ms.
    *_, before, last = Ramp(JERKY).speeds(0.5, 69)
    assert before < 0.5 == last
    ramp = Ramp(JERKY)
    fast = ramp.speeds(1.0, 30)[-1]
    assert ramp.follow(REST).linear == pytest.approx(fast - 0.01)
    assert moving(0.5, 0.0, JERKY).coast().linear == pytest.approx(0.49)


@each("sign", [1.0, -1.0])
def test_the_slope_falls_no_faster_than_jerk_unless_the_goal_would_be_passed(sign: float) -> None:
    ramp = Ramp(JERKY)
    assert ramp.speeds(sign, 10)[-1] == pytest.approx(sign * 0.0275)
    # The slope falls from 10 steps to 9; then the goal is one step away.
    assert ramp.speeds(sign * 0.0325, 2) == pytest.approx([sign * 0.032, sign * 0.0325])
    # After coasting it begins from a level slope: 5 and 20 rad/s3 x 10 ms x 10 ms.
    ramp, wish = Ramp(JERKY), Twist(sign * 0.5, sign * 2.0)
    ramp.path(wish, 20)
    left = ramp.coast()
    expected = near(left.linear + sign * 0.0005, left.angular + sign * 0.002)
    assert pair(ramp.follow(wish)) == expected


def rising(speeds: list[float]) -> list[Pair]:
    """Return, for each step that speeds up, its slope and the slope of the next step."""
    return [
        ((b - a) / DT, (c - b) / DT)
        for (a, b), (_, c) in pairwise(pairwise([speeds[0], *speeds]))
        if abs(c) > abs(b)
    ]


@law
@given(start=millimetres, goal=millimetres, way=st.sampled_from((1.0, -1.0)))
def test_jerk_bounds_the_change_of_slope_on_the_way_to_a_goal(
    start: float, goal: float, way: float
) -> None:
    # The slope may change by 5 m/s3 x 10 ms in a step.
    start, goal = (way * speed for speed in sorted((abs(start), abs(goal))))
    path = [start, *moving(start, 0.0, JERKY).speeds(goal, 400)]
    assert path[-1] == goal
    assert all(abs(after - before) <= 0.05 + EPS for before, after in rising(path))


@law
@given(wishes=st.lists(st.tuples(mixed, st.integers(1, 40)), max_size=8))
def test_jerk_bounds_how_much_steeper_a_slope_gets_whatever_is_commanded(
    wishes: list[tuple[Twist, int]],
) -> None:
    ramp, path = Ramp(JERKY), [REST]
    for wish, steps in wishes:
        path += ramp.path(wish, steps)
    for step, speeds in ((0.05, [t.linear for t in path]), (0.2, [t.angular for t in path])):
        for before, after in rising(speeds):
            slope = abs(before) if before * after > 0.0 else 0.0
            assert abs(after) <= slope + step + EPS


@law
@given(goals=st.lists(st.tuples(millimetres, st.integers(1, 40)), max_size=8))
def test_jerk_bounds_how_fast_a_slope_levels_out_short_of_the_goal(
    goals: list[tuple[float, int]],
) -> None:
    ramp, speed, slope = Ramp(JERKY), 0.0, 0.0
    for goal, steps in goals:
        for now in ramp.speeds(goal, steps):
            before, slope, speed = slope, (now - speed) / DT, now
            if speed not in (goal, 0.0) and slope * before > 0.0 and slope * speed > 0.0:
                assert abs(slope) >= abs(before) - 0.05 - EPS


@law
@given(start=millimetres, goal=millimetres, dt=st.floats(0.005, 0.05), jerk=st.floats(2.0, 500.0))
def test_with_jerk_the_goal_is_approached_from_one_side_reached_and_never_overshot(
    start: float, goal: float, dt: float, jerk: float
) -> None:
    ramp = moving(start, 0.0, LimitsConfig(linear_jerk=jerk, wheel_speed=99.99))
    path = [twist.linear for twist in ramp.path(Twist(goal, 0.0), int(6.0 / dt), dt)]
    assert path[-1] == pytest.approx(goal, abs=EPS)
    for before, after in pairwise([start, *path]):
        assert (after - before) * (goal - start) >= -EPS
        assert min(start, goal) - EPS <= after <= max(start, goal) + EPS


def test_with_jerk_a_lowered_acceleration_and_a_reversal_keep_the_limit() -> None:
    ramp = Ramp(JERKY)
    before = ramp.speeds(1.0, 30)[-1]
    ramp.limits = replace(JERKY, linear_acceleration=0.3)
    assert ramp.follow(Twist(1.0)).linear <= before + 0.3 * DT + EPS
    ramp = moving(1.0, 0.0, replace(JERKY, linear_deceleration=2.51))
    for before, now in pairwise([1.0, *ramp.speeds(-1.0, 200)]):
        assert before > 0.0 or abs(now - before) <= JERKY.linear_acceleration * DT + EPS
    assert ramp.twist.linear == pytest.approx(-1.0)
