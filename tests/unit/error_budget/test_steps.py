"""Driving is cut into steps: no part of the path is lost, and each cause stays in its step."""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsard.config.settings import DriveConfig
from acsard.drive.kinematics import Kinematics
from acsard.error_budget.drive_log import Stood, motion
from acsard.error_budget.rounding import rounding
from acsard.error_budget.steps import Driving, Step, mirrored
from tests.unit.error_budget.drives import Told, late, rounded

KINEMATICS = Kinematics(DriveConfig())


def driving(told: Told, gyro: bool = False) -> Driving:
    moved = motion(told.lines, np.zeros(0), KINEMATICS, whole=True)
    found = rounding(np.array([line.speeds for line in told.lines]), moved.period)
    return Driving(told.lines, moved, found, KINEMATICS, 0.1, gyro)


@pytest.fixture(scope="module")
def told() -> Told:
    return rounded(1, 10.0)


def test_the_steps_are_the_way(told: Told) -> None:
    steps = driving(told).plain()
    assert len(steps) == pytest.approx(100, abs=1)
    first, last = told.lines[0], told.lines[-1]
    rolled = (np.subtract(last.positions, first.positions)).mean() * 0.05
    assert sum(step.distance for step in steps) == pytest.approx(rolled)
    assert sum(step.turn for step in steps) == pytest.approx(last.yaw - first.yaw)


def test_rounding_is_in_every_step_that_moves(told: Told) -> None:
    steps = driving(told).rounded()
    assert all(step.along > 0.0 for step in steps if abs(step.distance) > 0.01)


def test_the_time_of_lines_is_in_blocks() -> None:
    steps = driving(late(1, 10.0, "batches")).late()
    assert 10 <= sum(step.along > 0.0 for step in steps) <= 21


def test_nothing_is_missed_where_all_lines_came(told: Told) -> None:
    assert driving(told).missed() == []


def test_wheels_of_a_side_that_agree_contradict_nobody(told: Told) -> None:
    assert driving(told).contradicted() == []


def test_where_a_gyro_turns_no_wheel_errs_in_the_heading(told: Told) -> None:
    steps = driving(told, gyro=True).rounded()
    assert not any(step.yaw for step in steps)
    assert all(step.by_gyro is not None for step in steps)


def test_mirrored_it_turns_left_by_as_much_and_errs_to_the_other_side() -> None:
    step = Step(0.1, -0.2, 1.0, 2.0, Stood(0.3, 0.4))
    assert mirrored(step) == Step(0.1, 0.2, 1.0, 2.0, Stood(0.3, -0.4))
    assert mirrored(mirrored(step)) == mirrored(step)
    assert math.copysign(1.0, mirrored(step).turn) == 1.0
