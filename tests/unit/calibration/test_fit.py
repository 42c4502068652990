"""Tests of Gauss-Newton and the jackknife on a linear model with a known answer."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.evidence import COUNT, LEFT, RIGHT, TURN, of_rows
from acsard.calibration.fit import Fit, fit

START = np.array([1.0, 1.0, 1.0, *[0.0] * (COUNT - 3)])
TRUTH = np.array([0.99, 1.01, 0.7])


def fitted(rng: np.random.Generator, shared: float, own: float, blocks: int = 20) -> Fit:
    """Fit blocks of 30 rows, linear in left, right and turn.

    The `shared` noise is equal within a block.
    """
    block = np.repeat(np.arange(blocks), 30)
    columns = rng.normal(size=(len(block), 3))
    noise = rng.normal(0, own, len(block))
    noise += (rng.normal(0, shared, (blocks, 3))[block] * columns).sum(axis=1)
    seen = columns @ TRUTH + noise

    def source(parameters):  # type: ignore[no-untyped-def]
        jacobian = np.zeros((len(block), COUNT))
        jacobian[:, :3] = columns
        residual = seen - columns @ parameters[:3]
        return of_rows(jacobian, residual, np.ones(len(block)), block, blocks)

    return fit([source], START, places=True)


def test_it_finds_what_is_there() -> None:
    assert fitted(np.random.default_rng(1), 0.0, 0.0).parameters[:3] == pytest.approx(TRUTH)


@pytest.mark.slow
@pytest.mark.parametrize(("shared", "own"), [(0.0, 0.05), (0.02, 0.0), (0.02, 0.05)])
def test_its_deviations_cover_the_truth_however_errors_hang_together(
    shared: float, own: float
) -> None:
    rng = np.random.default_rng(7)
    z = []
    for _ in range(60):
        found = fitted(rng, shared, own)
        z.append((found.parameters[:3] - TRUTH) / np.sqrt(np.diag(found.covariance()))[:3])
    assert np.mean(np.abs(z) < 2) > 0.93
    assert 0.6 < np.std(z) < 1.2


def test_a_track_that_differs_from_block_to_block_is_told_from_noise() -> None:
    rng = np.random.default_rng(3)
    assert fitted(rng, 0.02, 0.01).varies == pytest.approx(0.02 / 0.7, rel=0.7)
    assert fitted(rng, 0.0, 0.05).varies < 0.015


def test_without_a_block_is_what_a_fit_without_it_gives() -> None:
    found = fitted(np.random.default_rng(5), 0.01, 0.05)
    out = np.arange(20) == 4
    normal = found.normal[~out].sum(axis=0)[:3, :3]
    score = (found.score + found.normal @ found.parameters)[~out].sum(axis=0)[:3]
    assert found.without(out)[[LEFT, RIGHT, TURN]] == pytest.approx(np.linalg.solve(normal, score))


def test_parameters_can_be_told_apart_by_the_normal_equations_of_the_three() -> None:
    found = fitted(np.random.default_rng(5), 0.0, 0.05)
    assert np.linalg.cond(found.apart()) < 3
