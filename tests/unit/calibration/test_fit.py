"""Tests of the Gauss-Newton fit and the jackknife on data with a known answer.

Further tests check the evidence and the multipliers.
"""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.fit import (
    PARAMETER_COUNT,
    PRIOR_STD,
    Base,
    Fit,
    Parameter,
    evidence_from_measurements,
    fit,
    huber,
)
from acsard.calibration.heading import Rates, rates
from acsard.calibration.multipliers import Multipliers, configured, multipliers
from tests.unit.calibration.cut import BASE, ideal, ready, table

START = np.array([1.0, 1.0, 1.0, *[0.0] * (PARAMETER_COUNT - 3)])
TRUTH = np.array([0.99, 1.01, 0.7])


def fitted(rng: np.random.Generator, shared: float, own: float, blocks: int = 20) -> Fit:
    """Fit a model that is linear in left, right and turn to blocks of 30 rows each.

    The `shared` noise is equal for all rows of a block.
    """
    block = np.repeat(np.arange(blocks), 30)
    columns = rng.normal(size=(len(block), 3))
    noise = rng.normal(0, own, len(block))
    noise += (rng.normal(0, shared, (blocks, 3))[block] * columns).sum(axis=1)
    values = columns @ TRUTH + noise

    def source(parameters):  # type: ignore[no-untyped-def]
        jacobian = np.zeros((len(block), PARAMETER_COUNT))
        jacobian[:, :3] = columns
        residual = values - columns @ parameters[:3]
        return evidence_from_measurements(jacobian, residual, np.ones(len(block)), block, blocks)

    return fit([source], START, places=True)


def test_a_fit_without_noise_finds_the_true_parameters() -> None:
    assert fitted(np.random.default_rng(1), 0.0, 0.0).parameters[:3] == pytest.approx(TRUTH)


@pytest.mark.slow
@pytest.mark.parametrize(("shared", "own"), [(0.0, 0.05), (0.02, 0.0), (0.02, 0.05)])
def test_standard_deviations_cover_the_truth_however_errors_are_correlated(
    shared: float, own: float
) -> None:
    rng = np.random.default_rng(7)
    z = []
    for _ in range(60):
        result = fitted(rng, shared, own)
        z.append((result.parameters[:3] - TRUTH) / np.sqrt(np.diag(result.covariance()))[:3])
    assert np.mean(np.abs(z) < 2) > 0.93
    assert 0.6 < np.std(z) < 1.2


def test_errors_that_last_for_a_whole_run_widen_the_deviations_by_run() -> None:
    """Each of six runs has its own constant error.

    A standard deviation from the differences between blocks does not contain this error.
    """
    known, runs = np.diag([0.0] * 3 + [1.0] * (PARAMETER_COUNT - 3)), np.repeat(np.arange(6), 4)
    normal = np.zeros((24, PARAMETER_COUNT, PARAMETER_COUNT))
    normal[:, range(3), range(3)] = 1.0
    z: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(30):
        errors = np.random.default_rng(seed).normal(0.0, 0.02, (6, 3))[runs]
        mean = errors.mean(axis=0)
        score = np.pad(errors - mean, ((0, 0), (0, PARAMETER_COUNT - 3)))
        result = Fit(START, normal, score, known, tuple(Parameter)[:3], True, {})
        for by_run, scores in z.items():
            std = np.sqrt(np.diag(result.covariance(runs.tolist() if by_run else ())))
            scores += (mean / std[:3]).tolist()
    with_runs, alone = (float(np.sqrt(np.mean(np.square(z[key])))) for key in (True, False))
    assert 0.5 < with_runs < 1.0 < alone


def test_removing_a_block_gives_the_parameters_of_a_fit_without_it() -> None:
    result = fitted(np.random.default_rng(5), 0.01, 0.05)
    out = np.arange(20) == 4
    normal = result.normal[~out].sum(axis=0)[:3, :3]
    score = (result.score + result.normal @ result.parameters)[~out].sum(axis=0)[:3]
    assert result.without(out)[
        [Parameter.LEFT, Parameter.RIGHT, Parameter.INVERSE_TRACK]
    ] == pytest.approx(np.linalg.solve(normal, score))


def test_the_normal_equations_of_the_three_parameters_are_well_conditioned() -> None:
    result = fitted(np.random.default_rng(5), 0.0, 0.05)
    assert np.linalg.cond(result.marginal()) < 3


def fit_of(rate: float) -> Fit:
    """Return a fit with nearly exact parameters."""
    parameters = np.array([0.99, 1.01, 0.625, rate, *[0.0] * (PARAMETER_COUNT - 4)])
    normal = np.tile(np.eye(PARAMETER_COUNT) * 1e12, (12, 1, 1))
    known, score = np.zeros((PARAMETER_COUNT, PARAMETER_COUNT)), np.zeros((12, PARAMETER_COUNT))
    return Fit(parameters, normal, score, known, tuple(Parameter)[:4], True, PRIOR_STD)


def multipliers_of(fitted: Fit, rate: Rates) -> Multipliers:
    return multipliers(fitted.parameters, fitted.covariance(), rate)


def test_a_constant_track_is_the_inverse_of_the_turn() -> None:
    made = multipliers_of(fit_of(0.0), Rates(0.5, 1.0))
    assert made.values == pytest.approx([1.6, 0.99, 1.01])
    assert made.std == pytest.approx([0, 0, 0], abs=1e-4)


def test_a_track_that_grows_with_the_turn_rate_is_taken_at_the_mean_rate() -> None:
    made = multipliers_of(fit_of(0.08), Rates(0.5, 1.0))
    assert made.values[0] == pytest.approx(1.6 / (1 - 0.04))
    assert made.std == pytest.approx([0, 0, 0], abs=1e-4)


def test_the_mean_and_fastest_rates_are_those_of_the_turns() -> None:
    rows = ready(table(ideal(), places=False)).rows
    made = rates(rows, rows.turned)
    assert 0.5 < made.mean < made.fastest < 1.0


def test_configured_multipliers_are_taken_unchanged_and_without_deviation() -> None:
    assert configured(Base(0.05, 0.3, 0.9, 1.1, 1.5)).values.tolist() == [1.5, 0.9, 1.1]
    assert configured(BASE).std.tolist() == [0, 0, 0]


def test_the_errors_of_track_ratio_and_scale_are_separated() -> None:
    # The scale is off by 1 %, each radius by another 0.1 %, the track by 2 %. All are independent.
    values = np.array([1.6, 1.1, 1.0])
    shares = np.diag([0.02, 0.001, 0.001]) ** 2 + 0.01**2
    own = Multipliers(values, shares * np.outer(values, values)).relative_deviations()
    assert own.scale == pytest.approx(0.01, rel=0.01)
    assert own.ratio == pytest.approx(0.001 * np.sqrt(2), rel=0.01)
    assert own.track == pytest.approx(0.02, rel=0.01)


def test_blocks_add_up_to_the_normal_equations_of_all_rows() -> None:
    rng = np.random.default_rng(1)
    jacobian, residual = rng.normal(size=(50, PARAMETER_COUNT)), rng.normal(size=50)
    weight, block = rng.uniform(size=50), rng.integers(0, 6, 50)
    made = evidence_from_measurements(jacobian, residual, weight, block, 7)
    assert np.allclose(made.normal.sum(axis=0), jacobian.T @ np.diag(weight) @ jacobian)
    assert np.allclose(made.score.sum(axis=0), jacobian.T @ (weight * residual))
    assert made.squares.sum() == pytest.approx(float(weight @ residual**2))
    assert made.counts[6] == 0


def test_only_large_residuals_have_less_weight() -> None:
    weights = huber(np.array([0.1, -0.5, 1.0, -20.0]), 1.0)
    assert weights[:3].tolist() == [1.0, 1.0, 1.0]
    assert weights[3] < 0.2
