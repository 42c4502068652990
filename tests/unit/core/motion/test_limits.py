"""Tests of the limits that turn a requested twist into a safe one.

The limits are speed, acceleration, deceleration, jerk and coasting.
"""

from __future__ import annotations

import math
from itertools import pairwise

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import DriveConfig, LimitsConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.limits import AT_REST
from acsard.core.values import REST, Twist
from tests.each import each

DT = 0.01
EPS = 1e-9
KINEMATICS = Kinematics(DriveConfig())

FREE = LimitsConfig(wheel_speed=99.99)
"""Default limits with wheels that never saturate: (1 + 4 x 0.15) / 0.05 = 32 rad/s."""

JERKY = LimitsConfig(linear_jerk=5.0, angular_jerk=20.0, wheel_speed=99.99)

UNEVEN = LimitsConfig(
    linear_speed=2.0,
    linear_acceleration=0.5,
    linear_deceleration=2.0,
    linear_stop_deceleration=4.0,
    angular_acceleration=1.0,
    angular_deceleration=6.0,
    angular_stop_deceleration=9.0,
    wheel_speed=99.99,
)

twists = st.builds(Twist, st.floats(-1.0, 1.0), st.floats(-4.0, 4.0))
wishes = st.builds(
    Twist,
    st.floats(allow_nan=False, allow_infinity=False),
    st.floats(allow_nan=False, allow_infinity=False),
)
mixed = st.one_of(
    wishes, st.builds(Twist, st.floats(-3.0, 3.0), st.floats(-9.0, 9.0)), st.just(REST)
)
periods = st.floats(0.001, 0.05)
millimetres = st.integers(-1000, 1000).map(lambda number: number / 1000)


class Ramp:
    """The motion of a robot whose limits may change."""

    def __init__(self, limits: LimitsConfig, kinematics: Kinematics = KINEMATICS) -> None:
        self.motion, self.limits, self.kinematics = AT_REST, limits, kinematics
        self.cap = math.inf

    @property
    def twist(self) -> Twist:
        return self.motion.twist

    def follow(self, wish: Twist, dt: float) -> Twist:
        self.motion = self.motion.follow(wish, dt, self.limits, self.kinematics, self.cap)
        return self.twist

    def coast(self, dt: float, stop: bool = False) -> Twist:
        self.motion = self.motion.coast(dt, self.limits, stop)
        return self.twist


def limiter(limits: LimitsConfig = FREE) -> Ramp:
    return Ramp(limits)


def moving(linear: float, angular: float = 0.0, limits: LimitsConfig = FREE) -> Ramp:
    """Return a limiter that has reached this twist and holds it."""
    ramp = limiter(limits)
    followed(ramp, Twist(linear, angular), 2, dt=1000.0)
    assert ramp.twist == Twist(linear, angular)
    return ramp


def followed(ramp: Ramp, wish: Twist, steps: int, dt: float = DT) -> list[Twist]:
    return [ramp.follow(wish, dt) for _ in range(steps)]


def approx(linear: float, angular: float) -> object:
    return pytest.approx((linear, angular), abs=1e-12)


def pair(twist: Twist) -> tuple[float, float]:
    return twist.linear, twist.angular


# speed


@each(
    ("wish", "end"),
    [
        # The limits are 1 m/s and 4 rad/s.
        ((0.7, 0.0), (0.7, 0.0)),
        ((2.0, 0.0), (1.0, 0.0)),
        ((-2.0, 0.0), (-1.0, 0.0)),
        ((0.0, 8.0), (0.0, 4.0)),
        ((0.0, -8.0), (0.0, -4.0)),
        # Both axes are scaled by the one that exceeds its limit most: 1 / 2 and 4 / 16.
        ((2.0, 2.0), (1.0, 1.0)),
        ((2.0, -2.0), (1.0, -1.0)),
        ((0.5, 16.0), (0.125, 4.0)),
        ((2.0, 16.0), (0.5, 4.0)),
        ((-4.0, 6.0), (-1.0, 1.5)),
        ((1e308, 1e308), (1.0, 1.0)),
        ((1e308, 0.0), (1.0, 0.0)),
    ],
)
def test_a_twist_beyond_the_speed_limits_is_scaled_as_a_whole(
    wish: tuple[float, float], end: tuple[float, float]
) -> None:
    assert pair(limiter().follow(Twist(*wish), 1000.0)) == approx(*end)


@given(wish=wishes)
def test_the_speed_limits_keep_the_curvature(wish: Twist) -> None:
    end = limiter().follow(wish, 1000.0)
    assert abs(end.linear) <= 1.0 + EPS
    assert abs(end.angular) <= 4.0 + EPS
    largest = max(abs(wish.linear), abs(wish.angular), 1.0)
    assert end.linear * (wish.angular / largest) == pytest.approx(
        end.angular * (wish.linear / largest), abs=EPS
    )


@each(
    ("limits", "wish", "end"),
    [
        (LimitsConfig(angular_speed=0.0), (0.5, 0.001), (0.5, 0.0)),
        (LimitsConfig(angular_speed=0.0), (2.0, -9.0), (1.0, 0.0)),
        (LimitsConfig(linear_speed=0.0), (0.5, 1.0), (0.0, 1.0)),
        (LimitsConfig(linear_speed=0.0), (-0.001, 8.0), (0.0, 4.0)),
        (LimitsConfig(linear_speed=0.0, angular_speed=0.0), (0.5, 1.0), (0.0, 0.0)),
    ],
)
def test_an_axis_with_a_limit_of_zero_is_left_out_and_the_other_is_followed(
    limits: LimitsConfig, wish: tuple[float, float], end: tuple[float, float]
) -> None:
    assert pair(limiter(limits).follow(Twist(*wish), 1000.0)) == approx(*end)


def test_a_wheel_that_would_be_too_fast_slows_the_whole_twist() -> None:
    # 1 m/s and 4 rad/s put the wheels at (1 -+ 0.6) / 0.05 = 8 and 32 rad/s; 16 rad/s is half of
    # that.
    slow = limiter(LimitsConfig(wheel_speed=16.0))
    assert pair(slow.follow(Twist(1.0, 4.0), 1000.0)) == approx(0.5, 2.0)


def test_no_wheel_is_too_fast_on_the_way_between_two_allowed_twists() -> None:
    # At 0.8 m/s all wheels have 16 rad/s; 4 rad/s take 12 rad/s. The robot turns before it has
    # slowed down.
    ramp = moving(0.8, 0.0, LimitsConfig(wheel_speed=16.0, linear_deceleration=0.1))
    for twist in followed(ramp, Twist(0.0, 4.0), 800):
        assert max(map(abs, KINEMATICS.wheel_speeds(twist).as_tuple())) <= 16.0 + EPS
    assert ramp.twist == Twist(0.0, 4.0)


@given(wishes=st.lists(st.tuples(mixed, periods), max_size=40), most=st.floats(0.1, 40.0))
def test_no_wheel_is_ever_faster_than_its_limit(
    wishes: list[tuple[Twist, float]], most: float
) -> None:
    # If it brakes much more slowly than it turns, it reaches corners that no goal asks for.
    slow = limiter(LimitsConfig(wheel_speed=most, linear_deceleration=0.1))
    for wish, dt in wishes:
        speeds = KINEMATICS.wheel_speeds(slow.follow(wish, dt))
        assert max(map(abs, speeds.as_tuple())) <= most * (1 + EPS)


TALL = LimitsConfig(
    linear_speed=1.0,
    linear_acceleration=0.5,
    linear_deceleration=0.4,
    angular_acceleration=8.0,
    angular_deceleration=8.0,
    wheel_speed=20.0,
)
"""Limits of a robot that topples if it brakes hard, and whose wheels may turn no faster than at its
linear speed."""


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_at_the_wheel_limit_a_turn_waits_until_the_robot_has_slowed_down(sign: float) -> None:
    ramp = moving(1.0, 0.0, TALL)
    first = ramp.follow(Twist(1.0, sign * 4.0), 0.1)
    # 0.04 m/s of the rim are free when the robot has slowed down by 0.04 m/s.
    assert pair(first) == approx(0.96, sign * 0.04 / 0.15)
    last = followed(ramp, Twist(1.0, sign * 4.0), 2000)[-1]
    assert pair(last) == approx(1.0 / 1.6, sign * 4.0 / 1.6)


def test_at_the_wheel_limit_the_robot_speeds_up_as_its_turn_slows_down() -> None:
    limits = msgspec.structs.replace(TALL, wheel_speed=12.0, angular_deceleration=0.8)
    first = moving(0.0, 4.0, limits).follow(Twist(1.0, 0.0), 0.1)
    assert pair(first) == approx(0.08 * 0.15, 3.92)


def test_the_wheel_limit_counts_also_if_both_axes_speed_up() -> None:
    """The smaller left wheel turns faster straight ahead than in the curve to the left."""
    kinematics = Kinematics(DriveConfig(left_wheel_radius_multiplier=0.5))
    quick = msgspec.structs.replace(TALL, linear_acceleration=100.0, wheel_speed=30.0)
    first = Ramp(quick, kinematics).follow(Twist(1.0, 3.0), 0.01)
    assert max(map(abs, kinematics.wheel_speeds(first).as_tuple())) == pytest.approx(30.0)
    assert first.linear < 1.0


corners = st.builds(Twist, st.sampled_from((-1.0, 0.0, 1.0)), st.sampled_from((-4.0, 0.0, 4.0)))


@given(
    wishes=st.lists(st.tuples(corners | mixed, periods), max_size=40),
    start=corners,
    left=st.just(1.0) | st.floats(0.8, 1.25),
    braking=st.sampled_from((0.4, 4.0)),
)
def test_at_the_wheel_limit_too_each_axis_changes_by_no_more_than_its_limit(
    wishes: list[tuple[Twist, float]], start: Twist, left: float, braking: float
) -> None:
    kinematics = Kinematics(DriveConfig(left_wheel_radius_multiplier=left))
    ramp = Ramp(msgspec.structs.replace(TALL, linear_deceleration=braking), kinematics)
    before = ramp.follow(start, 1000.0)
    for wish, dt in wishes:
        after = ramp.follow(wish, dt)
        assert max(map(abs, kinematics.wheel_speeds(after).as_tuple())) <= 20.0 * (1 + EPS)
        assert abs(before.linear) - abs(after.linear) <= braking * dt + EPS
        assert abs(before.angular) - abs(after.angular) <= 8.0 * dt + EPS
        assert abs(after.linear) - abs(before.linear) <= 0.5 * dt + EPS
        assert abs(after.angular) - abs(before.angular) <= 8.0 * dt + EPS
        before = after


@pytest.mark.parametrize("side", ["left", "right"])
@given(wishes=st.lists(st.tuples(mixed, periods), max_size=10), goal=mixed)
def test_wheels_of_unequal_size_never_keep_the_robot_from_its_goal(
    side: str, wishes: list[tuple[Twist, float]], goal: Twist
) -> None:
    kinematics = Kinematics(DriveConfig(**{f"{side}_wheel_radius_multiplier": 0.8}))
    ramp = Ramp(TALL, kinematics)
    for wish, dt in wishes:
        ramp.follow(wish, dt)
    last = followed(ramp, goal, 2000)[-1]
    fresh = Ramp(TALL, kinematics).follow(goal, 1000.0)
    assert pair(last) == approx(*pair(fresh))


def test_a_small_wheel_at_its_limit_turns_the_robot_until_it_has_slowed_down() -> None:
    # Without the turn the right wheel would be too fast, so the turn falls only as fast as the
    # speed allows.
    kinematics = Kinematics(DriveConfig(right_wheel_radius_multiplier=0.9))
    ramp = Ramp(TALL, kinematics)
    start = ramp.follow(Twist(-1.0, 0.2), 1000.0)
    assert kinematics.wheel_speeds(start).front_right == pytest.approx(-20.0)
    after = ramp.follow(Twist(-0.8, 0.0), 0.01)
    assert abs(start.linear) - abs(after.linear) == pytest.approx(0.004)
    assert kinematics.wheel_speeds(after).front_right == pytest.approx(-20.0)
    assert 0.0 < after.angular < start.angular


@pytest.mark.parametrize(
    ("wheel_speed", "start", "goal", "dt"),
    [(1.0, Twist(0.0225, 0.1833333), REST, 0.02), (0.5, REST, Twist(0.0135, 0.075), 0.01)],
)
def test_a_very_small_wheel_at_its_limit_never_stops_the_way_to_the_goal(
    wheel_speed: float, start: Twist, goal: Twist, dt: float
) -> None:
    kinematics = Kinematics(DriveConfig(left_wheel_radius_multiplier=0.1))
    ramp = Ramp(LimitsConfig(wheel_speed=wheel_speed), kinematics)
    for step in range(1, 21):
        ramp.follow(Twist(start.linear * step / 20, start.angular * step / 20), dt)
    for _ in range(1000):
        ramp.follow(goal, dt)
    assert pair(ramp.twist) == approx(goal.linear, goal.angular)


# acceleration and deceleration


def test_speed_grows_by_the_acceleration_and_lands_on_the_goal() -> None:
    # Each step adds 1 m/s2 x 10 ms.
    series = followed(limiter(), Twist(0.035, 0.0), 5)
    assert [t.linear for t in series] == pytest.approx([0.01, 0.02, 0.03, 0.035, 0.035])
    assert series[-1].linear == 0.035


def test_the_two_axes_have_their_own_accelerations() -> None:
    # The step is 0.1 s at 0.5 m/s2 and 1 rad/s2.
    assert pair(limiter(UNEVEN).follow(Twist(2.0, 4.0), 0.1)) == approx(0.05, 0.1)


def test_the_two_axes_have_their_own_decelerations() -> None:
    # The step is 0.1 s at 2 m/s2 and 6 rad/s2.
    assert pair(moving(2.0, 4.0, UNEVEN).follow(REST, 0.1)) == approx(1.8, 3.4)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_only_slowing_down_uses_the_deceleration_in_both_directions(
    sign: float,
) -> None:
    slowing, hurrying = moving(sign * 1.0, 0.0, UNEVEN), moving(sign * 1.0, 0.0, UNEVEN)
    assert slowing.follow(Twist(sign * 0.5, 0.0), 0.1).linear == pytest.approx(sign * 0.8)
    assert hurrying.follow(Twist(sign * 1.5, 0.0), 0.1).linear == pytest.approx(sign * 1.05)


def test_a_step_of_zero_duration_changes_nothing() -> None:
    ramp = moving(0.5, 1.0)
    assert ramp.follow(REST, 0.0) == Twist(0.5, 1.0)


@given(wishes=st.lists(st.tuples(mixed, periods), max_size=40), start=twists)
def test_each_axis_changes_by_no_more_than_its_limit(
    wishes: list[tuple[Twist, float]], start: Twist
) -> None:
    ramp = limiter(UNEVEN)
    before = ramp.follow(start, 1000.0)
    for wish, dt in wishes:
        after = ramp.follow(wish, dt)
        for old, new, up, down in (
            (before.linear, after.linear, 0.5, 2.0),
            (before.angular, after.angular, 1.0, 6.0),
        ):
            most = up if abs(new) > abs(old) else down
            assert abs(new - old) <= most * dt + EPS
        before = after


@given(wish=twists, start=twists, dt=periods)
def test_a_goal_within_the_limits_is_reached_exactly_and_held(
    wish: Twist, start: Twist, dt: float
) -> None:
    ramp = limiter()
    ramp.follow(start, 1000.0)
    followed(ramp, wish, int(2.1 / dt) + 2, dt)
    assert ramp.twist == wish
    assert ramp.follow(wish, dt) == wish


@pytest.mark.parametrize("limits", [FREE, UNEVEN, JERKY], ids=["free", "uneven", "jerky"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_change_of_direction_passes_through_zero(limits: LimitsConfig, sign: float) -> None:
    ramp = moving(sign * 0.505, sign * 2.0, limits)
    path = followed(ramp, Twist(sign * -0.5, sign * -2.0), 800)
    assert path[-1] == Twist(sign * -0.5, sign * -2.0)
    assert min(abs(twist.linear) for twist in path) < EPS
    assert min(abs(twist.angular) for twist in path) < EPS


def test_a_change_of_direction_brakes_first_and_accelerates_after() -> None:
    # It brakes at 2 m/s2, 0.05 -> 0.03 -> 0.01 -> 0, and then accelerates at 0.5 m/s2, -0.005,
    # -0.01.
    path = followed(moving(0.05, 0.0, UNEVEN), Twist(-0.05, 0.0), 5)
    assert [t.linear for t in path] == pytest.approx([0.03, 0.01, 0.0, -0.005, -0.01])


# jerk


def test_jerk_lets_the_slope_grow_step_by_step() -> None:
    # At 5 m/s3 x 10 ms the slope is 0.05, 0.1, 0.15 m/s2. Each slope applies for 10 ms.
    path = followed(limiter(JERKY), Twist(1.0, 0.0), 3)
    assert [t.linear for t in path] == pytest.approx([0.0005, 0.0015, 0.003])


@each("sign", [1.0, -1.0])
@each(
    ("goal", "path"),
    [
        # Steps are 0.05 m/s2 and 10 ms; the slopes are 1, 2, 2, 1 and 1, 2, 3, 2, 1 steps.
        (0.0030, [0.0005, 0.0015, 0.0025, 0.0030, 0.0030]),
        (0.0045, [0.0005, 0.0015, 0.0030, 0.0040, 0.0045]),
        # These are 5.97 steps. After 1 and 2, the remaining 2.97 are 1.985 and 0.985, each one
        # less.
        (0.002985, [0.0005, 0.0015, 0.0024925, 0.002985, 0.002985]),
    ],
)
def test_jerk_lets_the_slope_fall_as_late_as_it_may(
    goal: float, path: list[float], sign: float
) -> None:
    series = followed(limiter(JERKY), Twist(sign * goal, 0.0), 5)
    assert [sign * twist.linear for twist in series] == pytest.approx(path)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_slope_falls_no_faster_than_jerk_unless_the_goal_would_be_passed(sign: float) -> None:
    ramp = limiter(JERKY)
    assert followed(ramp, Twist(sign, 0.0), 10)[-1].linear == pytest.approx(sign * 0.0275)
    # The slope falls from 10 steps to 9; then the goal is one step away.
    series = followed(ramp, Twist(sign * 0.0325, 0.0), 2)
    assert [sign * twist.linear for twist in series] == pytest.approx([0.032, 0.0325])


def test_a_large_change_of_speed_with_jerk_takes_the_time_worked_by_hand() -> None:
    # The slope rises to 1 m/s2 in 20 steps of 0.05 m/s2, which covers 0.105 m/s. It falls in 19
    # steps, which covers 0.095 m/s. The 0.3 m/s in between take 30 steps of 10 ms.
    path = followed(limiter(JERKY), Twist(0.5, 0.0), 69)
    assert path[-2].linear < 0.5
    assert path[-1].linear == 0.5


def slopes(speeds: list[float]) -> list[float]:
    return [(after - before) / DT for before, after in pairwise(speeds)]


def rising(speeds: list[float]) -> list[tuple[float, float]]:
    """Return, for each step that speeds up, its slope and the slope of the next step."""
    pairs = []
    for (a, b), (_, c) in pairwise(pairwise([speeds[0], *speeds])):
        if abs(c) > abs(b):
            pairs.append(((b - a) / DT, (c - b) / DT))
    return pairs


@given(start=millimetres, goal=millimetres, way=st.sampled_from((1.0, -1.0)))
def test_jerk_bounds_the_change_of_slope_on_the_way_to_a_goal(
    start: float, goal: float, way: float
) -> None:
    # The slope may change by 5 m/s3 x 10 ms in a step.
    start, goal = (way * speed for speed in sorted((abs(start), abs(goal))))
    ramp = moving(start, 0.0, JERKY)
    path = [start, *(twist.linear for twist in followed(ramp, Twist(goal, 0.0), 400))]
    assert path[-1] == goal
    for before, after in rising(path):
        assert abs(after - before) <= 0.05 + 1e-9


@given(wishes=st.lists(st.tuples(mixed, st.integers(1, 40)), max_size=8))
def test_jerk_bounds_how_much_steeper_a_slope_gets_whatever_is_commanded(
    wishes: list[tuple[Twist, int]],
) -> None:
    ramp = limiter(JERKY)
    path = [REST]
    for wish, steps in wishes:
        path += followed(ramp, wish, steps)
    for step, speeds in (
        (0.05, [twist.linear for twist in path]),
        (0.2, [twist.angular for twist in path]),
    ):
        for before, after in rising(speeds):
            slope = abs(before) if before * after > 0.0 else 0.0
            assert abs(after) <= slope + step + 1e-9


@given(goals=st.lists(st.tuples(millimetres, st.integers(1, 40)), max_size=8))
def test_jerk_bounds_how_fast_a_slope_levels_out_short_of_the_goal(
    goals: list[tuple[float, int]],
) -> None:
    ramp = limiter(JERKY)
    speed, slope = 0.0, 0.0
    for goal, steps in goals:
        for twist in followed(ramp, Twist(goal, 0.0), steps):
            before, slope = slope, (twist.linear - speed) / DT
            speed = twist.linear
            if speed not in (goal, 0.0) and slope * before > 0.0 and slope * speed > 0.0:
                assert abs(slope) >= abs(before) - 0.05 - 1e-9


def test_jerk_never_delays_braking() -> None:
    ramp = limiter(JERKY)
    fast = followed(ramp, Twist(1.0, 0.0), 30)[-1].linear
    assert ramp.follow(REST, DT).linear == pytest.approx(fast - 0.01)


@given(wishes=st.lists(st.tuples(mixed, st.integers(1, 60), periods), max_size=8))
def test_with_jerk_no_speed_or_acceleration_limit_is_exceeded(
    wishes: list[tuple[Twist, int, float]],
) -> None:
    ramp = limiter(JERKY)
    before = REST
    for wish, steps, dt in wishes:
        for after in followed(ramp, wish, steps, dt):
            assert abs(after.linear) <= 1.0 + EPS
            assert abs(after.angular) <= 4.0 + EPS
            assert abs(after.linear - before.linear) <= 1.0 * dt + EPS
            assert abs(after.angular - before.angular) <= 4.0 * dt + EPS
            before = after


@given(start=millimetres, goal=millimetres, dt=st.floats(0.005, 0.05), jerk=st.floats(2.0, 500.0))
def test_with_jerk_the_goal_is_approached_from_one_side_reached_and_never_overshot(
    start: float, goal: float, dt: float, jerk: float
) -> None:
    ramp = moving(start, 0.0, LimitsConfig(linear_jerk=jerk, wheel_speed=99.99))
    path = [twist.linear for twist in followed(ramp, Twist(goal, 0.0), int(6.0 / dt), dt)]
    assert path[-1] == pytest.approx(goal, abs=EPS)
    for before, after in pairwise([start, *path]):
        assert (after - before) * (goal - start) >= -EPS
        assert min(start, goal) - EPS <= after <= max(start, goal) + EPS


def test_with_jerk_a_lowered_acceleration_applies_from_the_next_step() -> None:
    ramp = limiter(JERKY)
    followed(ramp, Twist(1.0, 0.0), 30)
    ramp.limits = msgspec.structs.replace(JERKY, linear_acceleration=0.3)
    before = ramp.twist.linear
    assert ramp.follow(Twist(1.0, 0.0), DT).linear <= before + 0.3 * DT + EPS


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_with_jerk_a_reversal_speeds_up_no_faster_than_the_limit(
    sign: float,
) -> None:
    harder = msgspec.structs.replace(JERKY, linear_deceleration=2.51)
    ramp = moving(sign, 0.0, harder)
    for _ in range(200):
        before = ramp.twist.linear
        now = ramp.follow(Twist(-sign, 0.0), DT).linear
        if before * sign <= 0.0:
            assert abs(now - before) <= harder.linear_acceleration * DT + EPS
    assert ramp.twist.linear == pytest.approx(-sign)


# coasting


def test_coasting_falls_by_the_deceleration() -> None:
    # Each step removes 1 m/s2 x 10 ms.
    ramp = moving(0.035)
    assert [ramp.coast(DT).linear for _ in range(5)] == pytest.approx([0.025, 0.015, 0.005, 0, 0])
    assert ramp.twist == REST


def test_coasting_brings_both_axes_down_together_by_the_slower_of_them() -> None:
    # 0.5 m/s need 0.5 s and 4 rad/s need 1 s, so after 0.25 s three quarters of both remain.
    assert pair(moving(0.5, 4.0).coast(0.25)) == approx(0.375, 3.0)
    # 1 m/s needs 1 s and 1 rad/s needs 0.25 s, so three quarters remain again.
    assert pair(moving(1.0, 1.0).coast(0.25)) == approx(0.75, 0.75)


def test_coasting_for_a_negative_time_changes_nothing() -> None:
    ramp = moving(0.5, 4.0)
    assert pair(ramp.coast(-0.1)) == approx(0.5, 4.0)
    assert pair(ramp.coast(-1e9, stop=True)) == approx(0.5, 4.0)


def test_coasting_ends_at_rest_without_a_negative_zero() -> None:
    assert repr(moving(-0.5, -1.0).coast(1.0)) == repr(REST)


def test_a_stop_falls_by_its_own_higher_deceleration() -> None:
    # A step removes 3 m/s2 x 10 ms, or 12 rad/s2 x 10 ms.
    assert moving(1.0).coast(DT, stop=True).linear == pytest.approx(0.97)
    assert moving(0.0, -4.0).coast(DT, stop=True).angular == pytest.approx(-3.88)


@given(start=twists, dt=periods, stop=st.booleans())
def test_coasting_ends_at_rest_in_the_time_the_decelerations_take(
    start: Twist, dt: float, stop: bool
) -> None:
    ramp = limiter()
    ramp.follow(start, 1000.0)
    by = 3.0 if stop else 1.0
    seconds = max(abs(start.linear) / by, abs(start.angular) / (4 * by))
    steps = 0
    while ramp.twist != REST:
        ramp.coast(dt, stop)
        steps += 1
        assert steps <= seconds / dt + 2
    assert steps >= seconds / dt - 1


@given(start=twists, dts=st.lists(st.tuples(periods, st.booleans()), max_size=60))
def test_coasting_never_makes_a_wheel_faster_nor_turns_it_round(
    start: Twist, dts: list[tuple[float, bool]]
) -> None:
    ramp = limiter()
    before = KINEMATICS.wheel_speeds(ramp.follow(start, 1000.0)).as_tuple()
    for dt, stop in dts:
        after = KINEMATICS.wheel_speeds(ramp.coast(dt, stop)).as_tuple()
        for old, new in zip(before, after, strict=True):
            assert abs(new) <= abs(old) + 1e-12
            assert new * old >= -1e-12
        before = after


@given(start=twists, dts=st.lists(st.tuples(periods, st.booleans()), max_size=60))
def test_coasting_keeps_each_axis_within_its_deceleration(
    start: Twist, dts: list[tuple[float, bool]]
) -> None:
    ramp = limiter()
    before = ramp.follow(start, 1000.0)
    for dt, stop in dts:
        after, by = ramp.coast(dt, stop), 3.0 if stop else 1.0
        assert abs(after.linear - before.linear) <= by * dt + EPS
        assert abs(after.angular - before.angular) <= 4 * by * dt + EPS
        before = after


def test_jerk_never_delays_coasting() -> None:
    assert moving(0.5, 0.0, JERKY).coast(DT).linear == pytest.approx(0.49)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_after_coasting_jerk_begins_from_a_level_slope(sign: float) -> None:
    # The first step adds 5 m/s3 x 10 ms x 10 ms and 20 rad/s3 x 10 ms x 10 ms.
    ramp, wish = limiter(JERKY), Twist(sign * 0.5, sign * 2.0)
    followed(ramp, wish, 20)
    left = ramp.coast(DT)
    expected = approx(left.linear + sign * 0.0005, left.angular + sign * 0.002)
    assert pair(ramp.follow(wish, DT)) == expected


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_jerk_begins_at_rest_from_a_level_slope(sign: float) -> None:
    wish = Twist(sign * 0.5, sign * 2.0)
    assert pair(limiter(JERKY).follow(wish, DT)) == approx(sign * 0.0005, sign * 0.002)


SPEEDS = st.floats(0.0, 3.0)


@given(
    st.lists(st.tuples(SPEEDS | st.just(math.inf), SPEEDS, st.floats(-4.0, 4.0)), max_size=40),
)
def test_the_speed_never_exceeds_both_the_limit_and_the_cap_but_on_the_way_down(
    steps: list[tuple[float, float, float]],
) -> None:
    limits = LimitsConfig()
    ramp = Ramp(limits)
    for cap, setting, wish in steps:
        ramp.limits = msgspec.structs.replace(limits, linear_speed=setting)
        ramp.cap = cap
        for _ in range(5):
            before = abs(ramp.twist.linear)
            speed = abs(ramp.follow(Twist(wish), DT).linear)
            assert speed <= max(min(cap, setting), before - limits.linear_deceleration * DT) + 1e-9
