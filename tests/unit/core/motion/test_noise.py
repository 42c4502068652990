"""Tests of the noise of a step, and of the sensitivity to parameters."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.settings import DriveConfig, OdometryConfig
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.learned_track import CONFIGURED, Track
from acsard.core.motion.noise import Noise, columns
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
def test_a_k_of_each_side_can_be_said_with_the_settings(distance: float, turn: float) -> None:
    left, right = abs(distance - turn * L / 2), abs(distance + turn * L / 2)
    got = noise(K / 2, 2 * K / L**2, 0.0).of(distance, turn, abs(turn))
    assert got == pytest.approx(
        (K * (left + right) / 4, K * (left + right) / L**2, K * (right - left) / (2 * L)), abs=1e-18
    )


@pytest.mark.parametrize("settings", [(1e-4, 1e-4, 1e-2), (1e-6, 1.0, 0.0), (0.0, 1e-4, 0.0)])
def test_a_straight_has_the_variances_per_metre(settings: tuple[float, float, float]) -> None:
    along, yaw, both = noise(*settings).of(-2.0, 0.0, 0.0)
    assert (along, yaw, both) == pytest.approx((2 * settings[0], 2 * settings[1], 0.0))


def test_skidding_adds_to_what_counts_as_turned() -> None:
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
    """Return d and dyaw for wheel angles by equations (4) to (7)."""
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


def test_what_is_certain_has_no_column() -> None:
    assert columns(OdometryConfig(), Kinematics(DriveConfig())) == ()


def test_a_scale_that_is_off_bends_no_turn() -> None:
    config = OdometryConfig(distance_scale_std=0.01)
    assert columns(config, Kinematics(DriveConfig())) == ((0.01, 0.0, 0.0, 0.0),)


# a track that is learned

ALL = OdometryConfig(
    wheel_separation_multiplier_std=0.05,
    left_wheel_radius_multiplier_std=0.004,
    distance_scale_std=0.01,
)


def test_the_column_of_a_track_to_be_learned_is_the_last_and_does_nothing_at_first() -> None:
    kinematics = Kinematics(CALIBRATED)
    *declared, learned = columns(ALL, kinematics, CONFIGURED)
    assert tuple(declared) == columns(ALL, kinematics)
    assert learned == (0.0, 0.0, 0.0, 0.0)


def test_the_error_of_a_learned_track_takes_the_place_of_the_configured_ones() -> None:
    kinematics = Kinematics(CALIBRATED)
    left, separation, _, learned = columns(ALL, kinematics, Track(1.25, 0.03))
    assert separation == (0.0, 0.0, 0.0, 0.0)
    assert learned == (0.0, 0.0, 0.0, -0.03)
    wider = replace(
        CALIBRATED, wheel_separation_multiplier=1.25 * CALIBRATED.wheel_separation_multiplier
    )
    assert left == pytest.approx(columns(ALL, Kinematics(wider))[0])
