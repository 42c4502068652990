"""The improvement is measured on whole drives that the fit did not use."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from acsard.calibration.fit import fit
from acsard.calibration.heading import Rates
from acsard.calibration.improvement import (
    UNMEASURED,
    Fold,
    Improvement,
    drives,
    folds,
    improvement,
    no_better,
    positions_of,
    with_constant_track,
)
from acsard.calibration.runs import Block
from tests.unit.calibration.cut import BASE, ideal, log_of, ready, table
from tests.unit.calibration.robots import GUIDED, Drive

RATE = Rates(0.5, 1.0)


def cross_validation(drive: Drive, *, places: bool = True) -> tuple[list[Fold], Improvement]:
    """Fit this drive, and return its cross-validation folds and the measured improvement."""
    log = table(drive, places=places)
    made, runs = ready(log), log_of(log).runs
    fitted = fit(made.sources, made.start, places=places)
    cv_folds = folds(fitted, made.parts, runs, RATE)
    segments = [positions_of(fold.drive, runs) for fold in cv_folds]
    return cv_folds, improvement(cv_folds, BASE.start(), BASE, made.rows, segments, made.steps)


def test_every_part_of_one_run_is_left_out_in_turn() -> None:
    cv_folds, _ = cross_validation(ideal(), places=False)
    assert len(cv_folds) == 5
    assert np.all(np.sum([fold.blocks for fold in cv_folds], axis=0) >= 1)


def test_with_three_runs_whole_runs_are_left_out() -> None:
    run = log_of(table(ideal())).runs[0]
    assert drives([run] * 3) == [Block(at, 0.0, float(run.t[-1])) for at in range(3)]


def test_positions_of_a_drive_are_cut_at_gaps_of_the_wheels() -> None:
    run = log_of(table(ideal())).runs[0]
    mask = (run.t < 20.0) | (run.t > 40.0)
    torn = replace(run, t=run.t[mask], left=run.left[mask], right=run.right[mask])
    begin, end = positions_of(drives([torn] * 3)[0], [torn])
    assert begin.t[-1] < 20.0 < 40.0 < end.t[0]


@pytest.mark.slow
def test_an_ideal_robot_has_its_track_error_before_and_no_error_after() -> None:
    _, better = cross_validation(ideal())
    assert better.turn.before == pytest.approx(0.6 * 360, rel=0.02)
    assert better.turn.after is not None
    assert better.turn.after < 1.0
    for error in (better.heading, better.place):
        assert error.before is not None
        assert error.after is not None
        assert error.after < error.before / 10
    assert better.sure


def test_without_a_drive_to_leave_out_no_improvement_is_sure() -> None:
    made = ready(table(ideal(), places=False))
    rows = replace(made.rows, turned=np.zeros_like(made.rows.turned))
    better = improvement([], BASE.start(), BASE, rows, [], [])
    assert (better.turn.before, better.heading.before, better.place.after) == (None, None, None)
    assert not better.sure
    assert "no drive of the log could be left out" in no_better(better)


def test_a_slow_curve_is_not_taken_for_a_straight_drive() -> None:
    """The turn rate is as low as in a straight drive, but the turn per metre is much larger."""
    _, better = cross_validation(ideal([*GUIDED, (60.0, 0.04, 0.06)]), places=False)
    assert better.straight.before is not None
    assert better.straight.before < 5.0


def test_a_straight_drive_of_half_a_metre_gives_no_error_after_ten() -> None:
    curves = [(8.0, 0.2, 1.0), (8.0, 0.2, -1.0)] * 2
    _, better = cross_validation(
        ideal([(3.0, 0.0, 0.0), *curves, (3.0, 0.17, 0.0), *curves]), places=False
    )
    assert better.straight.before is None
    assert better.turn.before is not None


def test_one_track_for_all_rates_gives_the_same_turn_at_the_mean_rate() -> None:
    fixed = with_constant_track(np.array([1, 1, 0.6, 0.1, 0, 0, 0]), RATE)
    assert fixed.tolist() == pytest.approx([1, 1, 0.6 * 0.95, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("gain", "gain_std", "sure"),
    [(0.3, 0.1, True), (0.15, 0.1, False), (0.8, 1.0, True), (0.6, 1.0, False), (-0.1, 0.0, False)],
)
def test_a_gain_is_sure_beyond_two_deviations_or_if_the_error_is_halved(
    gain: float, gain_std: float, sure: bool
) -> None:
    assert replace(UNMEASURED, log_improvement=gain, gain_std=gain_std).sure == sure


@pytest.mark.parametrize(
    ("apart", "gain", "sure"),
    [(1.5, 0.8, False), (2.5, 0.8, True), (2.5, 0.15, False), (3.5, 0.15, False), (6.0, 0.15, True),
     (6.0, 0.05, False), (60.0, -0.01, False)],
)  # fmt: skip
def test_multipliers_that_are_far_from_the_configured_ones_need_less_gain(
    apart: float, gain: float, sure: bool
) -> None:
    assert replace(UNMEASURED, log_improvement=gain, gain_std=0.1, apart=apart).sure == sure
