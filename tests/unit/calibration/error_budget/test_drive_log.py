"""Tests that derive the motion of a robot and its errors from its lines."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.error_budget.drive_log import Line, motion
from acsard.core.config.settings import DriveConfig
from acsard.core.motion.kinematics import Kinematics

KINEMATICS = Kinematics(DriveConfig())
SPEED, PERIOD = 10.0, 0.01
"""Speed of all wheels, rad/s; this is 0.5 m/s."""
NONE = np.zeros(0)


def ahead(at: list[float], moved: list[float] | None = None) -> list[Line]:
    """Return lines of a straight drive; `moved` is the motion of odometry in each line, rad."""
    speeds = (SPEED,) * 4
    steps = [SPEED * PERIOD] * len(at) if moved is None else moved
    turned = np.cumsum(steps).tolist()
    return [Line(t, speeds, (p,) * 4, 0.0, 0.0) for t, p in zip(at, turned, strict=True)]


def even(count: int) -> list[float]:
    return [n * PERIOD for n in range(count)]


def test_distance_and_time_are_those_of_the_drive() -> None:
    found = motion(ahead(even(101)), NONE, KINEMATICS, whole=True)
    assert found.distance.sum() == pytest.approx(0.5)
    assert found.seconds == pytest.approx(1.0)
    assert (found.missing, found.unseen) == (0, 0.0)
    assert not found.late.any() or np.abs(found.late).max() < 1e-12


def test_a_gap_in_which_the_pose_stood_is_all_the_way_that_was_driven_in_it() -> None:
    at = even(100) + [1.5 + t for t in even(100)]
    moved = [SPEED * PERIOD] * 200
    moved[100] = 0.0
    found = motion(ahead(at, moved), NONE, KINEMATICS, whole=True)
    (unfilled,) = found.unfilled[found.unfilled.any(axis=1)]
    assert unfilled[0] == pytest.approx(0.5 * 0.51)
    assert found.unseen == pytest.approx(0.51)


def test_lines_that_are_missing_are_a_doubt_where_the_pose_went_on() -> None:
    at, moved = even(200), [SPEED * PERIOD] * 197
    del at[100:103]
    moved[100] = 4 * SPEED * PERIOD
    found = motion(ahead(at, moved), NONE, KINEMATICS, whole=True)
    assert found.missing == 3
    assert found.unseen == pytest.approx(0.03)
    assert np.flatnonzero(found.filled[:, 0]).tolist() == [99]
    assert not found.unfilled.any()


def test_lines_that_only_we_have_missed_are_no_gap() -> None:
    at, moved = even(200), [SPEED * PERIOD] * 197
    del at[100:103]
    moved[100] = 4 * SPEED * PERIOD
    found = motion(ahead(at, moved), NONE, KINEMATICS, whole=False)
    assert (found.missing, found.unseen) == (0, 0.0)


def test_lines_that_are_late_at_one_speed_change_nothing() -> None:
    rng = np.random.default_rng(1)
    at = np.sort(np.array(even(300)) + rng.exponential(0.002, 300)).tolist()
    found = motion(ahead(at), NONE, KINEMATICS, whole=True)
    assert found.lateness == pytest.approx(0.002, rel=0.3)
    assert not found.late.any()
