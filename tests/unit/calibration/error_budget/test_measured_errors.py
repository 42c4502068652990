"""Tests of the errors that lines show: late and missing lines, motion, rounding and steps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsard.calibration.error_budget.measured_errors import (
    DriveSteps,
    Driving,
    Line,
    line_times,
    motion,
    rounding,
)
from acsard.calibration.log_table import Floats
from acsard.core.config.settings import DriveConfig
from acsard.core.motion.kinematics import Kinematics
from tests.each import each
from tests.unit.calibration.error_budget.drives import ReportedDrive, late, rounded

PERIOD = 0.01
KINEMATICS = Kinematics(DriveConfig())
NONE = np.zeros(0)
EVEN = np.asarray(np.arange(600) * PERIOD, dtype=np.float64)


def test_evenly_spaced_lines_are_neither_late_nor_missing() -> None:
    timing = line_times(EVEN, NONE)
    assert np.abs(timing.late).max() < 1e-9
    assert timing.period == pytest.approx(PERIOD)
    assert not timing.missing.any()


@each("period", [0.00997, 0.01, 0.0102, 0.05])
def test_the_period_is_found_from_the_times_of_the_lines(period: float) -> None:
    t = np.asarray(np.arange(400) * period, dtype=np.float64)
    assert line_times(t, NONE).period == pytest.approx(period, rel=1e-6)


def test_a_line_that_is_read_late_is_late_and_not_missing() -> None:
    late = EVEN.copy()
    late[300:308] = late[308]  # a stall of the host delays all reads to its end
    timing = line_times(late, NONE)
    assert not timing.missing.any()
    assert timing.late[300] == pytest.approx(0.08, abs=0.002)
    assert abs(timing.late[400]) < 0.002


def test_lines_that_an_adapter_holds_back_are_not_missing() -> None:
    timing = line_times(np.ceil(EVEN / 0.016) * 0.016, NONE)
    assert not timing.missing.any()
    assert 0.003 < float(np.std(timing.late)) < 0.006  # a uniform delay over 16 ms has 4.6


@each("count", [1, 2, 5, 20])
def test_missing_lines_are_counted_at_their_place(count: int) -> None:
    rng = np.random.default_rng(1)
    arrivals = np.delete(EVEN, np.arange(300, 300 + count)) + rng.uniform(0, 0.001, 600 - count)
    timing = line_times(np.sort(arrivals), NONE)
    assert np.flatnonzero(timing.missing).tolist() == [300]
    assert timing.missing[300] == count
    assert np.abs(timing.late).max() < 0.002


def test_replies_are_timed_from_their_sent_lines_however_unevenly_these_left() -> None:
    rng = np.random.default_rng(2)
    sent = np.cumsum(rng.choice([0.004, 0.01, 0.013], 600))
    timing = line_times(sent[3:] + 0.006, sent)
    assert np.abs(timing.late).max() < 1e-9
    assert not timing.missing.any()
    assert not line_times(np.delete(sent[3:], 200) + 0.002, sent).missing[:190].any()


def test_lines_with_equal_stamps_raise_no_error() -> None:
    assert len(line_times(np.zeros(40), NONE).late) == 40


SPEED = 10.0
"""Speed of all wheels, rad/s; this is 0.5 m/s."""


def ahead(at: list[float], moved: list[float] | None = None) -> list[Line]:
    """Return the lines of a straight drive forward with these timestamps.

    `moved` is how far odometry turns the wheels in each line, rad.
    """
    speeds = (SPEED,) * 4
    steps = [SPEED * PERIOD] * len(at) if moved is None else moved
    turned = np.cumsum(steps).tolist()
    return [Line(t, speeds, (p,) * 4, 0.0, 0.0) for t, p in zip(at, turned, strict=True)]


def even(count: int) -> list[float]:
    return [n * PERIOD for n in range(count)]


def test_distance_and_time_are_those_of_the_drive() -> None:
    result = motion(ahead(even(101)), NONE, KINEMATICS, whole=True)
    assert result.distance.sum() == pytest.approx(0.5)
    assert result.seconds == pytest.approx(1.0)
    assert (result.missing, result.unseen) == (0, 0.0)
    assert not result.late.any() or np.abs(result.late).max() < 1e-12


def test_a_gap_without_motion_of_the_pose_is_unfilled_by_the_way_driven_in_it() -> None:
    at = even(100) + [1.5 + t for t in even(100)]
    moved = [SPEED * PERIOD] * 200
    moved[100] = 0.0
    result = motion(ahead(at, moved), NONE, KINEMATICS, whole=True)
    (unfilled,) = result.unfilled[result.unfilled.any(axis=1)]
    assert unfilled[0] == pytest.approx(0.5 * 0.51)
    assert result.unseen == pytest.approx(0.51)


def test_missing_lines_over_which_the_pose_continued_make_a_filled_gap() -> None:
    at, moved = even(200), [SPEED * PERIOD] * 197
    del at[100:103]
    moved[100] = 4 * SPEED * PERIOD
    result = motion(ahead(at, moved), NONE, KINEMATICS, whole=True)
    assert result.missing == 3
    assert result.unseen == pytest.approx(0.03)
    assert np.flatnonzero(result.filled[:, 0]).tolist() == [99]
    assert not result.unfilled.any()


def test_lines_that_only_this_program_missed_are_not_a_gap() -> None:
    at, moved = even(200), [SPEED * PERIOD] * 197
    del at[100:103]
    moved[100] = 4 * SPEED * PERIOD
    result = motion(ahead(at, moved), NONE, KINEMATICS, whole=False)
    assert (result.missing, result.unseen) == (0, 0.0)


def test_late_lines_at_a_constant_speed_cause_no_error() -> None:
    rng = np.random.default_rng(1)
    at = np.sort(np.array(even(300)) + rng.exponential(0.002, 300)).tolist()
    result = motion(ahead(at), NONE, KINEMATICS, whole=True)
    assert result.lateness == pytest.approx(0.002, rel=0.3)
    assert not result.late.any()


COUNT = 4000


def four(*columns: Floats) -> Floats:
    return np.column_stack(columns)


@pytest.mark.slow
@pytest.mark.parametrize("ripple", [0.0, 0.03])
def test_the_variance_is_that_of_the_sum_of_the_rounding_errors(ripple: float) -> None:
    """A wheel with a steady speed has the same rounding error in every line.

    A wheel whose speed varies has a new rounding error in each line.
    """
    rng = np.random.default_rng(1)
    errors, sums = [], []
    for _ in range(60):
        true = rng.uniform(5, 15) + rng.normal(0, ripple, COUNT)
        speed = np.round(true, 2)
        errors.append(float((speed - true).sum()) * PERIOD)
        sums.append(float(rounding(four(speed, speed, speed, speed), PERIOD).variance[:, 0].sum()))
    assert np.mean(np.square(errors)) == pytest.approx(np.mean(sums), rel=0.6)


def test_the_rounding_errors_of_a_wheel_with_changing_speed_cancel_out() -> None:
    true = np.linspace(0.0, 10.0, 20_000)  # twenty lines for each hundredth
    speed = np.round(true, 2)
    result = rounding(four(speed, speed, speed, speed), PERIOD)
    assert math.sqrt(result.variance[:, 0].sum()) < 20 * 0.01 * PERIOD


def test_only_wheels_with_equal_speeds_have_equal_rounding_errors() -> None:
    rng = np.random.default_rng(2)
    first, other = (np.round(rng.uniform(5, 9, COUNT), 2) for _ in range(2))
    alike = rounding(four(first, other, other, first), PERIOD).equal_errors
    assert alike.tolist() == [[1, 0, 0, 1], [0, 1, 1, 0], [0, 1, 1, 0], [1, 0, 0, 1]]


def test_a_standing_wheel_has_no_rounding_error() -> None:
    assert not rounding(np.zeros((COUNT, 4)), PERIOD).variance.any()


@each("counts", [96, 400, 1000, 4000])
def test_firmware_that_counts_in_each_period_is_recognized_by_its_speeds(counts: int) -> None:
    rng = np.random.default_rng(counts)
    step = math.tau / counts
    turned = np.cumsum(8.0 + 6.0 * np.sin(np.arange(COUNT) / 300) + rng.normal(0, 0.1, COUNT))
    speed = np.round(np.diff(np.floor(turned * PERIOD / step)) * step / PERIOD, 2)
    result = rounding(four(speed, speed, speed, speed), PERIOD)
    assert result.count == pytest.approx(step, rel=1e-3)
    counted = np.diff(np.floor(turned * PERIOD / step)) * step
    assert result.offset[:, 0].sum() == pytest.approx((speed * PERIOD - counted).sum(), abs=0.1)


@each("seed", range(20))
def test_firmware_that_filters_is_not_taken_for_firmware_that_counts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    speeds: Floats = np.cumsum(rng.normal(0, 0.2, (300, 4)), axis=0).round(2)
    assert rounding(speeds, PERIOD).count == 0.0


def driving(drive: ReportedDrive, gyro: bool = False) -> Driving:
    moved = motion(drive.lines, np.zeros(0), KINEMATICS, whole=True)
    result = rounding(np.array([line.speeds for line in drive.lines]), moved.period)
    return Driving(drive.lines, moved, result, KINEMATICS, 0.1, gyro)


@pytest.fixture(scope="module")
def told() -> ReportedDrive:
    return rounded(1, 10.0)


def test_the_steps_add_up_to_the_driven_way_and_heading(told: ReportedDrive) -> None:
    rows = driving(told).plain().rows
    assert len(rows) == pytest.approx(100, abs=1)
    first, last = told.lines[0], told.lines[-1]
    rolled = (np.subtract(last.positions, first.positions)).mean() * 0.05
    assert rows[:, 0].sum() == pytest.approx(rolled)
    assert rows[:, 1].sum() == pytest.approx(last.yaw - first.yaw)


def test_every_step_that_moves_has_a_rounding_error(told: ReportedDrive) -> None:
    rows = driving(told).rounded().rows
    assert rows[np.abs(rows[:, 0]) > 0.01, 2].all()


def test_time_errors_occur_in_blocks() -> None:
    assert 10 <= np.count_nonzero(driving(late(1, 10.0, "batches")).late().rows[:, 2]) <= 21


def test_no_step_has_a_gap_error_if_all_lines_came(told: ReportedDrive) -> None:
    assert not driving(told).missed().rows[:, 2:].any()


def test_wheels_of_a_side_that_agree_show_no_slip(told: ReportedDrive) -> None:
    assert not driving(told).contradicted().rows[:, 2:].any()


def test_if_a_gyro_gives_the_heading_rounding_changes_only_the_distance(
    told: ReportedDrive,
) -> None:
    steps = driving(told, gyro=True).rounded()
    assert steps.by_gyro
    assert steps.rows[:, 2].any()
    assert not steps.rows[:, 3].any()


def test_a_step_to_the_right_is_mirrored_into_a_step_to_the_left() -> None:
    right = [0.1, -0.2, 1.0, 2.0, 0.3, 0.4, 5.0, 6.0, 7.0]
    left = [0.1, 0.2, 1.0, 2.0, 0.3, -0.4, 5.0, 6.0, 7.0]
    assert DriveSteps(np.array([right, left])).to_the_left().rows.tolist() == [left, left]
