"""Tests of the error model: noise, effects of the parameters, and twist variances of a step."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.settings import DriveConfig, OdometryConfig
from acsard.core.motion.error_model import (
    LATERAL_VARIANCE,
    MIN_TWIST_VARIANCE,
    ErrorModel,
    Noise,
    TwistUncertainty,
    columns,
)
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import REST, Twist
from tests.vectors.drive import CALIBRATED

L = 0.30
K = 1e-4

steps = st.floats(-1.0, 1.0)


def noise(distance: float, yaw: float, skid: float) -> Noise:
    config = OdometryConfig(
        distance_variance_per_metre=distance,
        yaw_variance_per_metre=yaw,
        yaw_variance_per_radian=skid,
    )
    return Noise(config, Kinematics(DriveConfig()).track)


@given(distance=steps, turn=steps)
def test_a_noise_of_each_side_can_be_expressed_by_the_settings(
    distance: float, turn: float
) -> None:
    left, right = abs(distance - turn * L / 2), abs(distance + turn * L / 2)
    result = noise(K / 2, 2 * K / L**2, 0.0).of(distance, turn, abs(turn))
    assert result == pytest.approx(
        (K * (left + right) / 4, K * (left + right) / L**2, K * (right - left) / (2 * L)), abs=1e-18
    )


@pytest.mark.parametrize("settings", [(1e-4, 1e-4, 1e-2), (1e-6, 1.0, 0.0), (0.0, 1e-4, 0.0)])
def test_a_straight_has_the_variances_per_metre(settings: tuple[float, float, float]) -> None:
    along, yaw, both = noise(*settings).of(-2.0, 0.0, 0.0)
    assert (along, yaw, both) == pytest.approx((2 * settings[0], 2 * settings[1], 0.0))


def test_skidding_adds_to_the_turn_that_counts_for_the_yaw_variance() -> None:
    with_skid, without = noise(1e-4, 1e-4, 1e-2), noise(1e-4, 1e-4, 0.0)
    more = with_skid.of(0.1, 0.3, 0.2)[1] - without.of(0.1, 0.3, 0.2)[1]
    assert more == pytest.approx(2e-3)


variances = st.floats(0.0, 10.0)


@given(a=variances, b=variances, c=variances, distance=steps, turn=steps)
def test_no_setting_makes_a_variance_negative(
    a: float, b: float, c: float, distance: float, turn: float
) -> None:
    along, yaw, both = noise(a, b, c).of(distance, turn, abs(turn))
    assert along >= -1e-12 * (a + b)
    assert yaw >= -1e-12 * (a + b)
    assert abs(both) <= math.sqrt(max(0.0, along * yaw)) + 1e-9 * (a + b)


def step(drive: DriveConfig, left: float, right: float) -> tuple[float, float]:
    """Return the distance and the turn for wheel angles, by equations (4) to (7)."""
    dl = drive.wheel_radius * drive.left_wheel_radius_multiplier * left
    dr = drive.wheel_radius * drive.right_wheel_radius_multiplier * right
    track = drive.wheel_separation * drive.wheel_separation_multiplier
    return (dl + dr) / 2, (dr - dl) / track


@pytest.mark.parametrize(
    "multiplier",
    [
        "left_wheel_radius_multiplier",
        "right_wheel_radius_multiplier",
        "wheel_separation_multiplier",
    ],
)
def test_a_column_is_the_derivative_by_its_multiplier(multiplier: str) -> None:
    std, tiny = 0.004, 1e-6
    config = replace(OdometryConfig(), **{f"{multiplier}_std": std})
    (column,) = columns(config, Kinematics(CALIBRATED))
    settings = {name: getattr(CALIBRATED, name) for name in CALIBRATED.__struct_fields__}
    bent = DriveConfig(**(settings | {multiplier: settings[multiplier] + tiny}))
    (d, turn), (d2, turn2) = step(CALIBRATED, 3.0, 5.0), step(bent, 3.0, 5.0)
    along, by_turn, yaw, of_turn = column
    assert along * d + by_turn * turn == pytest.approx((d2 - d) / tiny * std, rel=1e-4, abs=1e-9)
    assert yaw * d + of_turn * turn == pytest.approx((turn2 - turn) / tiny * std, rel=1e-4)


def test_a_certain_parameter_has_no_column() -> None:
    assert columns(OdometryConfig(), Kinematics(DriveConfig())) == ()


def test_an_error_of_the_distance_scale_does_not_change_the_turn() -> None:
    config = OdometryConfig(distance_scale_std=0.01)
    assert columns(config, Kinematics(DriveConfig())) == ((0.01, 0.0, 0.0, 0.0),)


# a track that is learned

ALL = OdometryConfig(
    wheel_separation_multiplier_std=0.05,
    left_wheel_radius_multiplier_std=0.004,
    distance_scale_std=0.01,
)


EXACT = OdometryConfig(
    distance_variance_per_metre=0.0, yaw_variance_per_metre=0.0, yaw_variance_per_radian=0.0
)


def uncertainty(config: OdometryConfig = EXACT, counts: int = 0) -> TwistUncertainty:
    return TwistUncertainty(ErrorModel(config, Kinematics(DriveConfig())), counts)


def test_the_rounding_to_two_decimals_gives_the_least_variance_of_the_turn_rate() -> None:
    # Four wheels have 0.01^2 / 12 rad2/s2 each. The twist uses a quarter of their sum, and the
    # difference of the sides.
    variances = uncertainty().of(Twist(0.5, 0.0), 0.01)
    assert variances.angular == pytest.approx(0.05**2 * 1e-4 / 12 / 0.3**2)
    assert variances.linear == MIN_TWIST_VARIANCE > 0.05**2 * 1e-4 / 48


def test_counts_are_coarser_than_decimals() -> None:
    # With 400 counts, one count in 10 ms is 1.570796 rad/s.
    variances = uncertainty(counts=400).of(Twist(0.5, 0.0), 0.01)
    assert variances.linear == pytest.approx(0.05**2 * 1.570796**2 / 48)
    assert variances.angular == pytest.approx(0.05**2 * 1.570796**2 / 12 / 0.09)


def test_counts_that_the_lines_show_are_as_coarse_as_those_that_are_configured() -> None:
    result = uncertainty().of(Twist(0.5, 0.0), 0.01, step=1.570796)
    configured = uncertainty(counts=400).of(Twist(0.5, 0.0), 0.01)
    assert result.linear == pytest.approx(configured.linear)
    assert result.angular == pytest.approx(configured.angular)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_twist_noise_is_the_noise_of_a_period_divided_by_the_square_of_the_period(
    sign: float,
) -> None:
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
        first = steady.of(Twist(0.5, 0.0), 0.01)
        other = batched.of(Twist(0.5, 0.0), 0.02 if i % 2 else 0.0)
        other = batched.of(Twist(0.5, 0.0), 1e-6 if i % 2 else 0.01)
    assert other.linear < 3 * first.linear


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
    assert late.linear == MIN_TWIST_VARIANCE
    assert early.angular > late.angular


def test_the_lateral_variance_is_small_at_rest_only() -> None:
    assert uncertainty().of(REST, 0.01).lateral == LATERAL_VARIANCE
    assert uncertainty().at_rest(1.0).lateral == MIN_TWIST_VARIANCE


def test_the_ratio_s_error_makes_one_side_larger_and_the_other_smaller() -> None:
    """An error of the ratio turns the robot as opposite errors of both radii do.

    It does not change the distance straight ahead.
    """
    ratio = columns(OdometryConfig(wheel_radius_ratio_std=0.01), Kinematics(DriveConfig()))
    both = columns(
        OdometryConfig(
            left_wheel_radius_multiplier_std=0.005, right_wheel_radius_multiplier_std=0.005
        ),
        Kinematics(DriveConfig()),
    )
    ((along, by_turn, yaw, of_turn),) = ratio
    left, right = both
    assert (along, by_turn, yaw, of_turn) == pytest.approx(
        tuple(b - a for a, b in zip(left, right, strict=True)), abs=1e-15
    )
    assert along == of_turn == 0.0


def test_the_deviations_of_slip_and_distance_scale_add_up_in_one_column() -> None:
    slip = columns(
        OdometryConfig(wheel_slip_std=0.03, distance_scale_std=0.04), Kinematics(DriveConfig())
    )
    assert slip[0] == pytest.approx((0.05, 0.0, 0.0, 0.0))
    alone = columns(OdometryConfig(distance_scale_std=0.013), Kinematics(DriveConfig()))
    assert alone == ((0.013, 0.0, 0.0, 0.0),)
