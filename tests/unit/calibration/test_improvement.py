"""The improvement is measured on data that the fit did not use."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.fit import Rates, fit
from acsard.calibration.improvement import (
    folds,
    improvement,
    turns_by_positions,
    with_constant_track,
)
from tests.unit.calibration.cut import BASE, ideal, ready, table
from tests.unit.calibration.robots import GUIDED

RATE = Rates(0.5, 1.0)


def test_every_block_is_left_out_once() -> None:
    made = ready(table(ideal(), places=False))
    fitted = fit(made.sources, made.start, places=False)
    held = [one.blocks for one in folds(fitted, made.parts, RATE)]
    assert len(held) == 5
    assert np.sum(held, axis=0).tolist() == [1] * len(made.parts)


def test_an_ideal_robot_is_off_by_its_track_now_and_by_nothing_then() -> None:
    made = ready(table(ideal()))
    fitted = fit(made.sources, made.start, places=True)
    better = improvement(
        fitted, BASE, made.parts, RATE, made.rows, made.rows.turned, made.segments, made.steps
    )
    assert better.turn.before == pytest.approx(0.6 * 360, rel=0.02)
    assert better.turn.after is not None
    assert better.turn.after < 1.0
    assert better.place.before is not None
    assert better.place.after is not None
    assert better.place.after < better.place.before / 10


def test_without_anything_to_tell_an_error_by_there_is_none() -> None:
    made = ready(table(ideal(), places=False))
    fitted = fit(made.sources, made.start, places=False)
    better = improvement(
        fitted, BASE, made.parts, RATE, made.rows, np.zeros_like(made.rows.turned), [], []
    )
    assert (better.turn.before, better.place.after) == (None, None)


def test_a_slow_curve_is_no_straight() -> None:
    """The robot turns as slowly as a straight drive may, but turns much more in each metre."""
    slow = (60.0, 0.04, 0.06)
    made = ready(table(ideal([*GUIDED, slow]), places=False))
    fitted = fit(made.sources, made.start, places=False)
    better = improvement(fitted, BASE, made.parts, RATE, made.rows, made.rows.turned, [], [])
    assert better.straight.before is not None
    assert better.straight.before < 5.0


def test_positions_tell_how_far_it_turned() -> None:
    made = ready(table(ideal(), gyro=False))
    fitted = fit(made.sources, made.start, places=True)
    seen, true = turns_by_positions(fitted, made.rows, BASE), ready(table(ideal())).rows.turned
    assert np.abs(seen).sum() == pytest.approx(np.abs(true).sum(), rel=0.1)


def test_one_track_for_all_rates_turns_as_far_at_the_mean_rate() -> None:
    fixed = with_constant_track(np.array([1, 1, 0.6, 0.1, 0, 0, 0]), RATE)
    assert fixed.tolist() == pytest.approx([1, 1, 0.6 * 0.95, 0, 0, 0, 0])
