"""Tests of 6x6 covariances from a pose in the plane."""

from __future__ import annotations

import pytest

from acsard.core.config.settings import OdometryConfig
from acsard.core.messages.covariances import Covariances
from acsard.core.values import PoseCovariance, TwistVariances

OF_POSE = PoseCovariance(0.11, 0.12, 0.16, 0.22, 0.26, 0.66)
OF_TWIST = TwistVariances(0.01, 0.02, 0.06)
POSE = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
TWIST = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)


def covariances(**changes: object) -> Covariances:
    settings = {"pose_covariance_diagonal": POSE, "twist_covariance_diagonal": TWIST} | changes
    return Covariances(OdometryConfig(**settings))  # type: ignore[arg-type]


def diagonal(cells: list[float]) -> tuple[float, ...]:
    assert len(cells) == 36
    assert all(cell == 0.0 for i, cell in enumerate(cells) if i % 7)
    return tuple(cells[::7])


def test_with_the_model_covariance_the_twist_has_the_estimated_variances() -> None:
    assert diagonal(covariances().of_twist(OF_TWIST)) == (0.01, 0.02, 0.3, 0.4, 0.5, 0.06)


def test_with_the_constant_covariance_pose_and_twist_have_the_configured_variances() -> None:
    constant = covariances(covariance="constant")
    assert diagonal(constant.of_pose(OF_POSE)) == POSE
    assert diagonal(constant.of_twist(OF_TWIST)) == TWIST


@pytest.mark.parametrize(("configured", "published"), [(0.0, 1e-6), (1e9, 1e6), (2.0, 2.0)])
def test_variances_of_unmeasured_axes_are_limited_to_a_usable_range(
    configured: float, published: float
) -> None:
    rows = (0.1, 0.1, configured, configured, configured, 0.1)
    all_axes = covariances(pose_covariance_diagonal=rows, twist_covariance_diagonal=rows)
    assert all_axes.of_pose(OF_POSE)[14:29:7] == [published] * 3
    assert all_axes.of_twist(OF_TWIST)[14:29:7] == [published] * 3


def test_each_message_has_a_matrix_of_its_own() -> None:
    model = covariances(covariance="constant")
    first, second = model.of_pose(OF_POSE), model.of_pose(OF_POSE)
    assert first == second
    assert first is not second
