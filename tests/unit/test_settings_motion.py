"""The daemon refuses a configuration with dangerous limits and proposes a correction.

With such limits the robot could not stop in time, or would report a fault in normal driving.
"""

from __future__ import annotations

import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.motion_rules import MAX_RAMP_S, MAX_STOP_S, RULES
from acsard.core.config.partial import mistakes
from acsard.core.config.settings import (
    MAX_REPLY_PERIOD_S,
    Config,
    DriveConfig,
    FeedbackConfig,
    LimitsConfig,
    McuConfig,
)
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.limits import coast, follow
from acsard.core.values import AT_REST, REST, Twist

DT = 0.01


def problems(config: Config) -> list[str]:
    return mistakes(RULES, config)


def thousandths(low: float, high: float) -> st.SearchStrategy[float]:
    """Return a strategy for numbers with three decimals, as people write them."""
    return st.integers(round(low * 1000), round(high * 1000)).map(lambda number: number / 1000)


drives = st.builds(
    DriveConfig,
    wheel_radius=thousandths(0.02, 0.3),
    wheel_separation=thousandths(0.1, 1.0),
    wheel_separation_multiplier=thousandths(0.5, 2.0),
    left_wheel_radius_multiplier=thousandths(0.8, 1.2),
    right_wheel_radius_multiplier=thousandths(0.8, 1.2),
)
limits = st.builds(
    LimitsConfig,
    linear_speed=thousandths(0.0, 10.0),
    angular_speed=thousandths(0.0, 50.0),
    linear_deceleration=thousandths(0.01, 5.0),
    angular_deceleration=thousandths(0.01, 20.0),
    linear_stop_deceleration=thousandths(0.01, 20.0),
    angular_stop_deceleration=thousandths(0.01, 50.0),
    wheel_speed=thousandths(0.1, 99.99),
)


def mended(config: Config, line: str) -> Config:
    """Return the configuration with the number that the error message proposes."""
    match = re.match(r"(\w+)\.(\w+) = .*?write ([0-9.]+)", line)
    assert match is not None
    table, key, number = match.groups()
    changed = replace(getattr(config, table), **{key: float(number)})
    return replace(config, **{table: changed})


@given(
    drives,
    limits,
    thousandths(0.1, 99.99),
    thousandths(0.0, MAX_REPLY_PERIOD_S),
)
def test_following_the_advice_of_each_problem_leads_to_a_valid_configuration(
    drive: DriveConfig, limit: LimitsConfig, wheel_speed: float, period: float
) -> None:
    config = Config(
        drive=drive,
        limits=limit,
        feedback=FeedbackConfig(wheel_speed=wheel_speed),
        mcu=McuConfig(reply_period=period),
    )
    for _ in range(12):
        lines = problems(config)
        if not lines:
            return
        config = mended(config, lines[0])
    pytest.fail(f"it still says {lines}")


LOPSIDED = DriveConfig(
    wheel_radius=0.119,
    wheel_separation=0.703,
    wheel_separation_multiplier=1.83,
    left_wheel_radius_multiplier=0.8,
    right_wheel_radius_multiplier=1.051,
)
SOFT = LimitsConfig(
    linear_speed=0.065,
    angular_speed=0.321,
    linear_deceleration=0.01,
    angular_deceleration=0.01,
    linear_stop_deceleration=0.01,
    angular_stop_deceleration=0.01,
    wheel_speed=2.162,
)


@given(drives, limits, st.booleans(), st.sampled_from([(1, 0), (0, 1), (1, 1), (-1, 1)]))
@example(LOPSIDED, SOFT, False, (1, 1))
def test_every_accepted_robot_comes_to_rest_in_time_from_any_reachable_speed(
    drive: DriveConfig, limit: LimitsConfig, stop: bool, way: tuple[int, int]
) -> None:
    config = Config(drive=drive, limits=replace(limit, linear_acceleration=100.0))
    for _ in range(12):
        lines = problems(config)
        config = mended(config, lines[0]) if lines else config
    motion, wish = AT_REST, Twist(way[0] * 10.0, way[1] * 50.0)
    for _ in range(20):
        motion = follow(motion, wish, 10.0, config.limits, Kinematics(config.drive))
    longest = MAX_STOP_S if stop else MAX_RAMP_S
    for _ in range(round(longest / DT) + 1):
        motion = coast(motion, DT, config.limits, stop)
    assert motion.twist == REST


def test_a_stop_of_exactly_the_longest_duration_is_accepted_and_a_longer_one_is_not() -> None:
    def stops_by(stop: float) -> list[str]:
        soft = LimitsConfig(linear_deceleration=0.2, linear_stop_deceleration=stop)
        return problems(Config(limits=soft))

    assert stops_by(0.5) == []
    (line,) = stops_by(0.49)
    assert line.startswith("limits.linear_stop_deceleration = 0.49: braking from full speed")
    (line,) = stops_by(0.1)  # too soft, and softer than the ramp
    assert line.endswith("write 0.5 or more")


def test_a_speed_that_the_wheels_cannot_reach_does_not_count_for_braking() -> None:
    # 10 rad/s on a radius of 0.05 m are 0.5 m/s.
    slow = LimitsConfig(linear_speed=10.0, wheel_speed=10.0, linear_deceleration=0.1)
    assert problems(Config(limits=slow)) == []


@pytest.mark.parametrize(("wheel_speed", "good"), [(35.2, True), (35.1, False), (20.0, False)])
def test_the_largest_feedback_speed_must_exceed_the_commanded_speed_by_a_tenth(
    wheel_speed: float, good: bool
) -> None:
    # The limits ask for (1.0 m/s + 4.0 rad/s x 0.15 m) / 0.05 m = 32 rad/s, and a tenth is added.
    messages = problems(Config(feedback=FeedbackConfig(wheel_speed=wheel_speed)))
    assert (messages == []) is good
