"""Tests of the variances of one report's twist."""

from __future__ import annotations

import pytest

from acsard.core.config.settings import DriveConfig, OdometryConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.twist_uncertainty import LEAST, TwistUncertainty
from acsard.core.values import REST, Twist

EXACT = OdometryConfig(
    distance_variance_per_metre=0.0, yaw_variance_per_metre=0.0, yaw_variance_per_radian=0.0
)


def uncertainty(config: OdometryConfig = EXACT, counts: int = 0) -> TwistUncertainty:
    return TwistUncertainty(config, Kinematics(DriveConfig()), counts)


def test_two_decimals_are_the_turnings_least_doubt() -> None:
    # Four wheels have 0.01^2 / 12 rad2/s2 each. The twist uses a quarter of their sum, and the
    # difference of the sides.
    variances = uncertainty().of(Twist(0.5, 0.0), 0.01)
    assert variances.angular == pytest.approx(0.05**2 * 1e-4 / 12 / 0.3**2)
    assert variances.linear == LEAST > 0.05**2 * 1e-4 / 48


def test_counts_are_coarser_than_decimals() -> None:
    # With 400 counts, one count in 10 ms is 1.570796 rad/s.
    variances = uncertainty(counts=400).of(Twist(0.5, 0.0), 0.01)
    assert variances.linear == pytest.approx(0.05**2 * 1.570796**2 / 48)
    assert variances.angular == pytest.approx(0.05**2 * 1.570796**2 / 12 / 0.09)


def test_counts_that_the_lines_show_are_as_coarse_as_those_that_are_configured() -> None:
    shown = uncertainty().of(Twist(0.5, 0.0), 0.01, step=1.570796)
    configured = uncertainty(counts=400).of(Twist(0.5, 0.0), 0.01)
    assert shown.linear == pytest.approx(configured.linear)
    assert shown.angular == pytest.approx(configured.angular)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_noise_is_that_of_a_period_over_its_square(sign: float) -> None:
    # The noise is 1e-4 m2/m x 0.5 m/s / 0.01 s and 1e-4 rad2/m x 0.5 m/s / 0.01 s.
    variances = uncertainty(OdometryConfig()).of(Twist(0.5 * sign, 0.0), 0.01)
    assert variances.linear == pytest.approx(5e-3, rel=1e-3)
    assert variances.angular == pytest.approx(5e-3, rel=1e-3)


def test_parameters_scale_the_speed() -> None:
    both = OdometryConfig(
        distance_variance_per_metre=0.0,
        yaw_variance_per_metre=0.0,
        yaw_variance_per_radian=0.0,
        left_wheel_radius_multiplier_std=0.02,
        right_wheel_radius_multiplier_std=0.02,
        wheel_separation_multiplier_std=0.03,
    )
    # The radii add 0.02 of each side's half of 1 m/s. The turn of 2 rad/s adds 0.03, and the radii
    # over 0.3 m.
    variances = uncertainty(both).of(Twist(1.0, 0.0), 0.01)
    assert variances.linear == pytest.approx(2 * (0.02 * 0.5) ** 2, rel=1e-3)
    assert variances.angular == pytest.approx(2 * (0.02 / 0.3) ** 2, rel=1e-3)
    turning = uncertainty(both).of(Twist(0.0, 2.0), 0.01)
    assert turning.angular == pytest.approx((0.03 * 2) ** 2 + 2 * (0.02 * 2 / 2) ** 2, rel=1e-3)


def test_lines_that_are_read_together_have_the_period_of_the_others() -> None:
    steady, batched = uncertainty(OdometryConfig()), uncertainty(OdometryConfig())
    for i in range(400):
        one = steady.of(Twist(0.5, 0.0), 0.01)
        other = batched.of(Twist(0.5, 0.0), 0.02 if i % 2 else 0.0)
        other = batched.of(Twist(0.5, 0.0), 1e-6 if i % 2 else 0.01)
    assert other.linear < 3 * one.linear


def test_a_line_that_came_late_makes_no_longer_period() -> None:
    usual, late = uncertainty(OdometryConfig()), uncertainty(OdometryConfig())
    for _ in range(400):
        usual.of(Twist(0.5, 0.0), 0.01)
        late.of(Twist(0.5, 0.0), 0.01)
    late.of(Twist(0.5, 0.0), 0.5)
    after = late.of(Twist(0.5, 0.0), 0.01).linear
    assert after == pytest.approx(usual.of(Twist(0.5, 0.0), 0.01).linear, rel=0.1)


def test_at_rest_the_twist_is_certain() -> None:
    rest = uncertainty(OdometryConfig()).at_rest(0.21)
    assert (rest.linear, rest.lateral, rest.angular) == (1e-8,) * 3


def test_coarse_encoders_see_rest_only_after_a_while() -> None:
    coarse = uncertainty(counts=20)
    early, late = coarse.at_rest(0.3), coarse.at_rest(60.0)
    assert early.linear > 1e-5
    assert late.linear == LEAST
    assert early.angular > late.angular


def test_to_the_side_it_is_what_is_configured_but_at_rest() -> None:
    config = OdometryConfig(twist_covariance_diagonal=(1.0, 0.25, 1.0, 1.0, 1.0, 1.0))
    assert uncertainty(config).of(REST, 0.01).lateral == 0.25
    assert uncertainty(config).at_rest(1.0).lateral == LEAST
