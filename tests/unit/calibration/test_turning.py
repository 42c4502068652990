"""Tests of turns measured by a sensor as evidence."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration import turning
from acsard.calibration.evidence import AHEAD, ASIDE, COUNT, LATE, huber
from tests.unit.calibration.cut import BASE, ideal, ready

AT = np.array([0.9, 1.1, 0.6, 0.05, *[0.0] * (COUNT - 4)])


def test_least_squares_find_both_sides_whatever_their_sign() -> None:
    rows = ready(ideal().csv(places=False)).rows
    left, right = turning.first(rows, BASE)
    assert left == pytest.approx(0.998 / 1.6, rel=1e-3)
    assert right == pytest.approx(1.002 / 1.6, rel=1e-3)
    assert np.allclose(
        turning.by_sides(rows, BASE, np.array([left, right])), rows.turned, atol=0.01
    )


def test_slopes_are_those_of_what_the_wheels_say() -> None:
    rows = ready(ideal().csv(places=False)).rows
    step = 1e-6
    score = turning.evidence(rows, BASE, AT, len(rows.turned)).score.sum(axis=0)
    for index in range(4):
        more = AT.copy()
        more[index] += step
        slope = (turning.turned(rows, BASE, more) - turning.turned(rows, BASE, AT)) / step
        residual = rows.turned - turning.turned(rows, BASE, AT)
        usual = np.hypot(
            turning.NOISE * rows.seconds, turning.SHARE * turning.turned(rows, BASE, AT)
        )
        weight = huber(residual / usual, 1.0)
        # The other parameters also change the rate term, but only to second order.
        assert score[index] == pytest.approx(float(slope @ (weight * residual)), rel=0.15)
    assert not score[[LATE, AHEAD, ASIDE]].any()
