"""Tests of the second-order terms of the covariance.

The tests compare them with errors that are composed step by step.
"""

from __future__ import annotations

import numpy as np
import pytest

from acsard.core.motion.se2 import bracket, carried, difference, seen_from
from acsard.core.motion.second_order import MAX_HEADING_VARIANCE, SecondOrder
from acsard.core.values import PoseCovariance

NONE = PoseCovariance(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def heading(variance: float) -> PoseCovariance:
    return PoseCovariance(0.0, 0.0, 0.0, 0.0, 0.0, variance)


def straight(metres: int, yaw: float, column: float) -> tuple[SecondOrder, PoseCovariance]:
    """Return the covariance after stretches of 0.1 m straight ahead.

    Each stretch adds this yaw variance and this effect of a parameter on yaw.
    """
    second, p = SecondOrder(1), NONE
    j = (0.0, 0.0, 0.0)
    for _ in range(10 * metres):
        before, j_before = carried(p, 0.1, 0.0), seen_from(j, 0.1, 0.0)
        p = difference(before, heading(-yaw / 10))
        j = (j_before[0], j_before[1], j_before[2] + column / 10)
        second.carry(0.1, 0.0)
        w = (0.0, 0.0, column / 10)
        second.compose(before, difference(p, before), [j_before], [w])
    return second, p


def sampled(metres: int, yaw: float, column: float) -> float:
    """Return the mean square of the bracket terms along 20,000 random paths like in `straight`."""
    rng = np.random.default_rng(1)
    n = 20_000
    p = rng.standard_normal(n)
    x, y, turned, second = (np.zeros(n) for _ in range(4))
    for _ in range(10 * metres):
        y = y + 0.1 * turned
        new = np.sqrt(yaw / 10) * rng.standard_normal(n) + p * column / 10
        second += bracket((x, y, turned), (0.0, 0.0, new))[0] / 2  # type: ignore[arg-type]
        turned = turned + new
    return float((second**2).mean())


@pytest.mark.parametrize(("yaw", "column"), [(1e-3, 0.0), (0.0, 0.01), (1e-3, 0.01), (1e-3, 0.03)])
def test_the_second_order_terms_of_noise_and_a_parameter_agree_with_sampling(
    yaw: float, column: float
) -> None:
    second, _ = straight(10, yaw, column)
    assert second.xx == pytest.approx(sampled(10, yaw, column), rel=0.06)
    assert second.yy == pytest.approx(0.0, abs=1e-12)


def test_heading_noise_on_a_straight_has_a_48th_of_its_square() -> None:
    second, _ = straight(20, 1e-4, 0.0)
    assert second.xx == pytest.approx(1e-8 * 20**4 / 48, rel=0.02)


def test_an_unknown_heading_adds_no_second_order_term() -> None:
    second = SecondOrder(0)
    p = PoseCovariance(1.0, 0.0, 0.0, 1.0, 0.0, MAX_HEADING_VARIANCE * 1.01)
    assert second.compose(p, heading(0.1), [], []) == NONE
    assert (second.xx, second.xy, second.yy) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("column", [0.0, 3.0])
@pytest.mark.parametrize("yaw", [1.1, 10.0])
def test_a_stretch_that_makes_the_heading_unknown_adds_no_second_order_term(
    yaw: float, column: float
) -> None:
    second, p = straight(20, 1e-4, 0.001)
    before = (second.xx, second.xy, second.yy)
    j, noise = (0.0, 0.0, 0.02), 0.0 if column else yaw
    assert second.compose(p, heading(noise), [j], [(0.0, 0.0, column)]) == NONE
    assert (second.xx, second.xy, second.yy) == before


def test_an_additional_column_does_not_change_the_existing_terms() -> None:
    second, p = straight(5, 1e-3, 0.01)
    before = second.xx
    second.add_parameter()
    none = (0.0, 0.0, 0.0)
    second.compose(p, NONE, [none, none], [none, none])
    assert second.xx == pytest.approx(before)
