"""Tests of the sums over blocks and of the weight of outliers."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.evidence import COUNT, huber, of_rows


def test_blocks_add_up_to_the_normal_equations_of_all_rows() -> None:
    rng = np.random.default_rng(1)
    jacobian, residual = rng.normal(size=(50, COUNT)), rng.normal(size=50)
    weight, block = rng.uniform(size=50), rng.integers(0, 6, 50)
    made = of_rows(jacobian, residual, weight, block, 7)
    assert np.allclose(made.normal.sum(axis=0), jacobian.T @ np.diag(weight) @ jacobian)
    assert np.allclose(made.score.sum(axis=0), jacobian.T @ (weight * residual))
    assert made.squares.sum() == pytest.approx(float(weight @ residual**2))
    assert made.counts[6] == 0


def test_only_what_is_far_off_counts_less() -> None:
    weights = huber(np.array([0.1, -0.5, 1.0, -20.0]), 1.0)
    assert weights[:3].tolist() == [1.0, 1.0, 1.0]
    assert weights[3] < 0.2
