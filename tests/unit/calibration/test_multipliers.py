"""Tests that turn fitted parameters into settings."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.evidence import COUNT, Base
from acsard.calibration.fit import USUAL, Fit
from acsard.calibration.multipliers import Multipliers, Rates, configured, found, rates
from tests.unit.calibration.cut import BASE, ideal, ready


def fit_of(rate: float, varies: float) -> Fit:
    """Return a fit with nearly exact parameters, except for the track, which varies."""
    parameters = np.array([0.99, 1.01, 0.625, rate, *[0.0] * (COUNT - 4)])
    normal = np.tile(np.eye(COUNT) * 1e12, (12, 1, 1))
    return Fit(
        parameters,
        normal,
        np.zeros((12, COUNT)),
        np.zeros((COUNT, COUNT)),
        (0, 1, 2, 3),
        varies,
        True,
        USUAL,
    )


def test_a_constant_track_is_the_inverse_of_the_turn() -> None:
    made = found(fit_of(0.0, 0.0), Rates(0.5, 1.0))
    assert made.values == pytest.approx([1.6, 0.99, 1.01])
    assert made.std == pytest.approx([0, 0, 0], abs=1e-4)


def test_a_track_that_grows_is_taken_at_the_mean_rate_and_covers_the_slowest() -> None:
    made = found(fit_of(0.08, 0.0), Rates(0.5, 1.0))
    assert made.values[0] == pytest.approx(1.6 / (1 - 0.04))
    assert made.std[0] == pytest.approx(made.values[0] * 0.04, rel=1e-3)


def test_a_track_that_differs_from_block_to_block_is_as_unsure() -> None:
    made = found(fit_of(0.0, 0.1), Rates(0.5, 1.0))
    assert made.std[0] == pytest.approx(0.16, rel=1e-3)


def test_rates_are_those_of_the_turns() -> None:
    rows = ready(ideal().csv(places=False)).rows
    made = rates(rows, rows.turned)
    assert 0.5 < made.mean < made.fastest < 1.0


def test_what_is_configured_is_taken_as_it_is() -> None:
    assert configured(Base(0.05, 0.3, 0.9, 1.1, 1.5)).values.tolist() == [1.5, 0.9, 1.1]
    assert configured(BASE).std.tolist() == [0, 0, 0]


def test_what_all_three_have_in_common_is_told_apart_from_what_each_has_alone() -> None:
    # The scale is off by 1 %, each radius by another 0.1 %, the track by 2 %. All are independent.
    values = np.array([1.6, 1.1, 1.0])
    shares = np.diag([0.02, 0.001, 0.001]) ** 2 + 0.01**2
    own, scale = Multipliers(values, shares * np.outer(values, values)).own()
    assert scale == pytest.approx(0.01, rel=0.01)
    assert own / values == pytest.approx([0.02, 0.001, 0.001], rel=0.01)


def test_radii_that_are_the_least_known_are_no_scale_and_no_track() -> None:
    values = np.array([1.6, 1.1, 1.0])
    shares = np.diag([0.01, 0.03, 0.03]) ** 2
    own, scale = Multipliers(values, shares * np.outer(values, values)).own()
    assert scale == pytest.approx(0.0, abs=1e-9)
    assert own / values == pytest.approx([0.01, 0.03, 0.03])
