"""Limits turn a requested twist into a safe one: speed, wheels, acceleration, jerk, coasting."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.settings import DriveConfig, LimitsConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.limits import coast, follow
from acsard.core.values import AT_REST, REST, Twist
from tests.each import each
from tests.wheels import STEADY

law = settings(max_examples=100)
Pair = tuple[float, float]


def near(linear: float, angular: float) -> object:
    return pytest.approx((linear, angular), abs=1e-12)


def pair(twist: Twist) -> Pair:
    return twist.linear, twist.angular


DT = 0.01
EPS = 1e-9
KINEMATICS = Kinematics(DriveConfig())
FREE = replace(STEADY, wheel_speed=99.99)
"""Limits with wheels that never saturate: (1 + 4 x 0.15) / 0.05 = 32 rad/s."""
JERKY = replace(FREE, linear_jerk=5.0, angular_jerk=20.0)
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

twists = st.builds(Twist, st.floats(-1.0, 1.0), st.floats(-4.0, 4.0))
finite = st.floats(allow_nan=False, allow_infinity=False)
wishes = st.builds(Twist, finite, finite)
mixed = st.one_of(
    wishes, st.builds(Twist, st.floats(-3.0, 3.0), st.floats(-9.0, 9.0)), st.just(REST)
)
corners = st.builds(Twist, st.sampled_from((-1.0, 0.0, 1.0)), st.sampled_from((-4.0, 0.0, 4.0)))
periods = st.floats(0.001, 0.05)
millimetres = st.integers(-1000, 1000).map(lambda number: number / 1000)


class Ramp:
    """The motion of a robot whose limits may change."""

    def __init__(self, limits: LimitsConfig = FREE, drive: DriveConfig | None = None) -> None:
        self.motion, self.limits, self.cap = AT_REST, limits, math.inf
        self.kinematics = Kinematics(drive) if drive else KINEMATICS

    @property
    def twist(self) -> Twist:
        return self.motion.twist

    @property
    def fastest(self) -> float:
        return max(map(abs, self.kinematics.wheel_speeds(self.twist).as_tuple()))

    def follow(self, wish: Twist, dt: float = DT) -> Twist:
        self.motion = follow(self.motion, wish, dt, self.limits, self.kinematics, self.cap)
        return self.twist

    def path(self, wish: Twist, steps: int, dt: float = DT) -> list[Twist]:
        return [self.follow(wish, dt) for _ in range(steps)]

    def speeds(self, wish: float, steps: int) -> list[float]:
        return [twist.linear for twist in self.path(Twist(wish), steps)]

    def coast(self, dt: float = DT, stop: bool = False) -> Twist:
        self.motion = coast(self.motion, dt, self.limits, stop)
        return self.twist


def moving(linear: float, angular: float = 0.0, limits: LimitsConfig = FREE) -> Ramp:
    """Return a ramp that has reached this twist and holds it."""
    ramp = Ramp(limits)
    assert ramp.path(Twist(linear, angular), 2, 1000.0)[-1] == Twist(linear, angular)
    return ramp


NO_TURN, NO_DRIVE = LimitsConfig(angular_speed=0.0), LimitsConfig(linear_speed=0.0)


@each(
    ("limits", "wish", "end"),
    [
        # The limits are 1 m/s and 4 rad/s.
        (FREE, (0.7, 0.0), (0.7, 0.0)),
        (FREE, (2.0, 0.0), (1.0, 0.0)),
        (FREE, (0.0, -8.0), (0.0, -4.0)),
        # Both axes are scaled by the one that exceeds its limit most: 1 / 2 and 4 / 16.
        (FREE, (2.0, -2.0), (1.0, -1.0)),
        (FREE, (0.5, 16.0), (0.125, 4.0)),
        (FREE, (-4.0, 6.0), (-1.0, 1.5)),
        (FREE, (1e308, 1e308), (1.0, 1.0)),
        # An axis with a limit of zero is left out, and the other one is followed.
        (NO_TURN, (0.5, 0.001), (0.5, 0.0)),
        (NO_TURN, (2.0, -9.0), (1.0, 0.0)),
        (NO_DRIVE, (-0.001, 8.0), (0.0, 4.0)),
        (replace(NO_TURN, linear_speed=0.0), (0.5, 1.0), (0.0, 0.0)),
        # The wheels would turn at (1 -+ 0.6) / 0.05 = 8 and 32 rad/s.
        (LimitsConfig(wheel_speed=16.0), (1.0, 4.0), (0.5, 2.0)),
    ],
)
def test_a_twist_beyond_limits_is_scaled_whole(limits: LimitsConfig, wish: Pair, end: Pair) -> None:
    assert pair(Ramp(limits).follow(Twist(*wish), 1000.0)) == near(*end)


@law
@given(wish=wishes)
def test_the_speed_limits_keep_the_curvature(wish: Twist) -> None:
    end = Ramp().follow(wish, 1000.0)
    assert abs(end.linear) <= 1.0 + EPS
    assert abs(end.angular) <= 4.0 + EPS
    largest = max(abs(wish.linear), abs(wish.angular), 1.0)
    across = end.linear * (wish.angular / largest), end.angular * (wish.linear / largest)
    assert across[0] == pytest.approx(across[1], abs=EPS)


@law
@given(
    wishes=st.lists(st.tuples(corners | mixed, periods), max_size=40),
    start=corners | twists,
    limits=st.sampled_from((FREE, UNEVEN, JERKY, TALL, replace(TALL, linear_deceleration=4.0))),
    left=st.just(1.0) | st.floats(0.8, 1.25),
)
def test_each_axis_changes_by_no_more_than_its_limit_and_no_wheel_is_too_fast(
    wishes: list[tuple[Twist, float]], start: Twist, limits: LimitsConfig, left: float
) -> None:
    ramp = Ramp(limits, DriveConfig(left_wheel_radius_multiplier=left))
    before = ramp.follow(start, 1000.0)
    for wish, dt in wishes:
        after = ramp.follow(wish, dt)
        assert ramp.fastest <= limits.wheel_speed * (1 + EPS)
        for old, new, up, down in (
            (before.linear, after.linear, limits.linear_acceleration, limits.linear_deceleration),
            (
                before.angular, after.angular,
                limits.angular_acceleration, limits.angular_deceleration,
            ),
        ):  # fmt: skip
            assert abs(new) - abs(old) <= up * dt + EPS
            assert abs(old) - abs(new) <= down * dt + EPS
            assert abs(new - old) <= max(up, down) * dt + EPS
        before = after


@law
@given(wish=twists, start=twists, dt=periods)
def test_a_goal_within_limits_is_reached_and_held(wish: Twist, start: Twist, dt: float) -> None:
    ramp = Ramp()
    ramp.follow(start, 1000.0)
    ramp.path(wish, int(2.1 / dt) + 2, dt)
    assert ramp.twist == wish == ramp.follow(wish, dt)
    assert ramp.follow(REST, 0.0) == wish  # a step of no duration changes nothing


@each("sign", [1.0, -1.0])
def test_at_the_wheel_limit_one_axis_waits_for_the_other(sign: float) -> None:
    ramp = moving(1.0, 0.0, TALL)
    # 0.04 m/s of the rim are free when the robot has slowed down by 0.04 m/s.
    assert pair(ramp.follow(Twist(1.0, sign * 4.0), 0.1)) == near(0.96, sign * 0.04 / 0.15)
    assert pair(ramp.path(Twist(1.0, sign * 4.0), 2000)[-1]) == near(1.0 / 1.6, sign * 4.0 / 1.6)
    limits = replace(TALL, wheel_speed=12.0, angular_deceleration=0.8)
    first = moving(0.0, 4.0, limits).follow(Twist(1.0, 0.0), 0.1)
    assert pair(first) == near(0.08 * 0.15, 3.92)
    # The smaller left wheel turns faster straight ahead than in the curve to the left.
    both = Ramp(
        replace(TALL, linear_acceleration=100.0, wheel_speed=30.0),
        DriveConfig(left_wheel_radius_multiplier=0.5),
    )
    assert both.follow(Twist(1.0, 3.0)).linear < 1.0
    assert both.fastest == pytest.approx(30.0)


@each("sign", [1.0, -1.0])
@each(
    ("ramp", "wish", "path"),
    [
        # 1 m/s2 x 10 ms; braking at 2 m/s2 and then accelerating at 0.5 m/s2.
        (lambda: moving(0.0), 0.035, [0.01, 0.02, 0.03, 0.035, 0.035]),
        (lambda: moving(0.05, 0.0, UNEVEN), -0.05, [0.03, 0.01, 0.0, -0.005, -0.01]),
        (lambda: moving(1.0, 0.0, UNEVEN), 1.5, [1.005, 1.01]),
        # Steps of 5 m/s3 are 0.05 m/s2 and 10 ms: the slopes are 1, 2, 3, ...; 1, 2, 2, 1;
        # 1, 2, 3, 2, 1. 0.002985 are 5.97 steps: after 1 and 2 remain 1.985 and 0.985.
        (lambda: Ramp(JERKY), 1.0, [0.0005, 0.0015, 0.0030]),
        (lambda: Ramp(JERKY), 0.0030, [0.0005, 0.0015, 0.0025, 0.0030, 0.0030]),
        (lambda: Ramp(JERKY), 0.0045, [0.0005, 0.0015, 0.0030, 0.0040, 0.0045]),
        (lambda: Ramp(JERKY), 0.002985, [0.0005, 0.0015, 0.0024925, 0.002985, 0.002985]),
    ],
)
def test_paths_worked_by_hand(ramp: type, wish: float, path: list[float], sign: float) -> None:
    way: Ramp = ramp()
    if sign < 0:
        way.motion = replace(way.motion, twist=Twist(-way.twist.linear))
    assert [sign * speed for speed in way.speeds(sign * wish, len(path))] == pytest.approx(path)


# coasting


def test_coasting_worked_by_hand() -> None:
    # Each step removes 1 m/s2 x 10 ms.
    ramp = moving(0.035)
    assert [ramp.coast().linear for _ in range(5)] == pytest.approx([0.025, 0.015, 0.005, 0, 0])
    # 0.5 m/s need 0.5 s and 4 rad/s need 1 s, so after 0.25 s three quarters of both remain.
    assert pair(moving(0.5, 4.0).coast(0.25)) == near(0.375, 3.0)
    assert pair(moving(1.0, 1.0).coast(0.25)) == near(0.75, 0.75)
    # A stop removes 3 m/s2 x 10 ms, or 12 rad/s2 x 10 ms.
    assert moving(1.0).coast(stop=True).linear == pytest.approx(0.97)
    assert moving(0.0, -4.0).coast(stop=True).angular == pytest.approx(-3.88)
    assert pair(moving(0.5, 4.0).coast(-1e9, stop=True)) == near(0.5, 4.0)
    assert repr(moving(-0.5, -1.0).coast(1.0)) == repr(REST)  # no negative zero


@law
@given(start=twists, dt=periods, stop=st.booleans())
def test_coasting_ends_in_time_and_no_wheel_gets_faster(
    start: Twist, dt: float, stop: bool
) -> None:
    ramp, by, steps = Ramp(), 3.0 if stop else 1.0, 0
    before = ramp.follow(start, 1000.0)
    seconds = max(abs(start.linear) / by, abs(start.angular) / (4 * by))
    while before != REST:
        after, steps = ramp.coast(dt, stop), steps + 1
        assert steps <= seconds / dt + 2
        assert abs(after.linear - before.linear) <= by * dt + EPS
        assert abs(after.angular - before.angular) <= 4 * by * dt + EPS
        olds, news = (KINEMATICS.wheel_speeds(twist).as_tuple() for twist in (before, after))
        for old, new in zip(olds, news, strict=True):
            assert abs(new) <= abs(old) + 1e-12
            assert new * old >= -1e-12
        before = after
    assert steps >= seconds / dt - 1


SPEEDS = st.floats(0.0, 3.0)


@law
@given(st.lists(st.tuples(SPEEDS | st.just(math.inf), SPEEDS, st.floats(-4, 4)), max_size=40))
def test_the_speed_never_exceeds_both_the_limit_and_the_cap_but_on_the_way_down(
    steps: list[tuple[float, float, float]],
) -> None:
    ramp = Ramp(LimitsConfig())
    for cap, setting, wish in steps:
        ramp.limits, ramp.cap = replace(LimitsConfig(), linear_speed=setting), cap
        for _ in range(5):
            slower = abs(ramp.twist.linear) - ramp.limits.linear_deceleration * DT
            assert abs(ramp.follow(Twist(wish)).linear) <= max(min(cap, setting), slower) + EPS


# jerk


def test_jerk_takes_the_time_worked_by_hand_and_never_delays_braking() -> None:
    # The slope rises to 1 m/s2 in 20 steps of 0.05 m/s2, which covers 0.105 m/s. It falls in 19
    # steps, which covers 0.095 m/s. The 0.3 m/s in between take 30 steps of 10 ms.
    *_, before, last = Ramp(JERKY).speeds(0.5, 69)
    assert before < 0.5 == last
    ramp = Ramp(JERKY)
    fast = ramp.speeds(1.0, 30)[-1]
    assert ramp.follow(REST).linear == pytest.approx(fast - 0.01)
    assert moving(0.5, 0.0, JERKY).coast().linear == pytest.approx(0.49)


def rising(speeds: list[float]) -> list[Pair]:
    """Return, for each step that speeds up, its slope and the slope of the next step."""
    return [
        ((b - a) / DT, (c - b) / DT)
        for (a, b), (_, c) in pairwise(pairwise([speeds[0], *speeds]))
        if abs(c) > abs(b)
    ]


@law
@given(wishes=st.lists(st.tuples(mixed, st.integers(1, 40)), max_size=8))
def test_jerk_bounds_how_much_steeper_a_slope_gets(
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
