"""Tests of 6x6 covariances from a pose in the plane."""

from __future__ import annotations

from acsard.core.messages.covariances import pose_covariance, twist_covariance
from acsard.core.values import PoseCovariance, TwistVariances

OF_POSE = PoseCovariance(0.11, 0.12, 0.16, 0.22, 0.26, 0.66)


def test_the_twist_has_the_estimated_variances_and_large_ones_for_unmeasured_axes() -> None:
    cells = twist_covariance(TwistVariances(0.01, 0.02, 0.06))
    assert len(cells) == 36
    assert all(cell == 0.0 for i, cell in enumerate(cells) if i % 7)
    assert cells[::7] == [0.01, 0.02, 1e6, 1e6, 1e6, 0.06]


def test_the_axes_that_wheels_do_not_measure_have_a_large_variance() -> None:
    assert pose_covariance(OF_POSE)[14:29:7] == [1e6] * 3


def test_each_message_has_a_matrix_of_its_own() -> None:
    first, second = pose_covariance(OF_POSE), pose_covariance(OF_POSE)
    assert first == second
    assert first is not second
