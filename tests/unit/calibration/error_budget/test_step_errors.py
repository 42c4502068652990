"""Tests of the errors of a step, with rounding against sums of actual rounding errors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsard.calibration.error_budget.drive_log import motion
from acsard.calibration.error_budget.step_errors import Driving, Floats, Steps, rounding
from acsard.core.config.settings import DriveConfig
from acsard.core.motion.kinematics import Kinematics
from tests.each import each
from tests.unit.calibration.error_budget.drives import Told, late, rounded

PERIOD, COUNT = 0.01, 4000


def four(*columns: Floats) -> Floats:
    return np.column_stack(columns)


@pytest.mark.slow
@pytest.mark.parametrize("ripple", [0.0, 0.03])
def test_the_variance_is_that_of_the_rounding_errors_sum(ripple: float) -> None:
    """A steady wheel has the same rounding error all the time.

    A wheel that trembles has a new one in each line.
    """
    rng = np.random.default_rng(1)
    errors, told = [], []
    for _ in range(60):
        true = rng.uniform(5, 15) + rng.normal(0, ripple, COUNT)
        said = np.round(true, 2)
        errors.append(float((said - true).sum()) * PERIOD)
        told.append(float(rounding(four(said, said, said, said), PERIOD).variance[:, 0].sum()))
    assert np.mean(np.square(errors)) == pytest.approx(np.mean(told), rel=0.6)


def test_a_wheel_that_passes_through_its_speeds_hardly_errs() -> None:
    true = np.linspace(0.0, 10.0, 20_000)  # twenty lines for each hundredth
    said = np.round(true, 2)
    found = rounding(four(said, said, said, said), PERIOD)
    assert math.sqrt(found.variance[:, 0].sum()) < 20 * 0.01 * PERIOD


def test_wheels_that_always_say_the_same_err_together_and_others_by_themselves() -> None:
    rng = np.random.default_rng(2)
    one, other = (np.round(rng.uniform(5, 9, COUNT), 2) for _ in range(2))
    alike = rounding(four(one, other, other, one), PERIOD).alike
    assert alike.tolist() == [[1, 0, 0, 1], [0, 1, 1, 0], [0, 1, 1, 0], [1, 0, 0, 1]]


def test_a_wheel_that_stands_does_not_err() -> None:
    assert not rounding(np.zeros((COUNT, 4)), PERIOD).variance.any()


@each("counts", [96, 400, 1000, 4000])
def test_a_firmware_that_counts_in_each_period_is_told_by_its_speeds(counts: int) -> None:
    rng = np.random.default_rng(counts)
    step = math.tau / counts
    turned = np.cumsum(8.0 + 6.0 * np.sin(np.arange(COUNT) / 300) + rng.normal(0, 0.1, COUNT))
    said = np.round(np.diff(np.floor(turned * PERIOD / step)) * step / PERIOD, 2)
    found = rounding(four(said, said, said, said), PERIOD)
    assert found.count == pytest.approx(step, rel=1e-3)
    counted = np.diff(np.floor(turned * PERIOD / step)) * step
    assert found.offset[:, 0].sum() == pytest.approx((said * PERIOD - counted).sum(), abs=0.1)


@each("seed", range(20))
def test_a_firmware_that_filters_is_not_taken_for_one_that_counts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    said: Floats = np.cumsum(rng.normal(0, 0.2, (300, 4)), axis=0).round(2)
    assert rounding(said, PERIOD).count == 0.0


KINEMATICS = Kinematics(DriveConfig())


def driving(told: Told, gyro: bool = False) -> Driving:
    moved = motion(told.lines, np.zeros(0), KINEMATICS, whole=True)
    found = rounding(np.array([line.speeds for line in told.lines]), moved.period)
    return Driving(told.lines, moved, found, KINEMATICS, 0.1, gyro)


@pytest.fixture(scope="module")
def told() -> Told:
    return rounded(1, 10.0)


def test_the_steps_are_the_way(told: Told) -> None:
    rows = driving(told).plain().rows
    assert len(rows) == pytest.approx(100, abs=1)
    first, last = told.lines[0], told.lines[-1]
    rolled = (np.subtract(last.positions, first.positions)).mean() * 0.05
    assert rows[:, 0].sum() == pytest.approx(rolled)
    assert rows[:, 1].sum() == pytest.approx(last.yaw - first.yaw)


def test_rounding_is_in_every_step_that_moves(told: Told) -> None:
    rows = driving(told).rounded().rows
    assert rows[np.abs(rows[:, 0]) > 0.01, 2].all()


def test_the_time_of_lines_is_in_blocks() -> None:
    assert 10 <= np.count_nonzero(driving(late(1, 10.0, "batches")).late().rows[:, 2]) <= 21


def test_nothing_is_missed_where_all_lines_came(told: Told) -> None:
    assert not driving(told).missed().rows[:, 2:].any()


def test_wheels_of_a_side_that_agree_contradict_nobody(told: Told) -> None:
    assert not driving(told).contradicted().rows[:, 2:].any()


def test_where_a_gyro_turns_no_wheel_errs_in_the_heading(told: Told) -> None:
    steps = driving(told, gyro=True).rounded()
    assert steps.by_gyro
    assert steps.rows[:, 2].any()
    assert not steps.rows[:, 3].any()


def test_to_the_left_a_step_turns_by_as_much_and_errs_to_the_other_side() -> None:
    right = [0.1, -0.2, 1.0, 2.0, 0.3, 0.4, 5.0, 6.0, 7.0]
    left = [0.1, 0.2, 1.0, 2.0, 0.3, -0.4, 5.0, 6.0, 7.0]
    assert Steps(np.array([right, left])).to_the_left().rows.tolist() == [left, left]
