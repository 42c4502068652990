"""Tests of wheel angles, rests and blocks."""

from __future__ import annotations

import numpy as np

from acsard.calibration.wheel_angles import angles_of, blocks, gaps, inside, rests
from tests.unit.calibration.cut import log_of

HEADER = "t,left,right,yaw_rate\n"


def drive(*parts: tuple[float, float, float]) -> str:
    """Return a log of parts (from, to, rad/s) at 100 Hz; the right side turns backward."""
    lines = []
    for begin, end, speed in parts:
        lines += [f"{t:.2f},{speed},{-speed}," for t in np.arange(begin, end, 0.01)]
    return HEADER + "\n".join(lines)


def test_angles_are_sums_of_speeds() -> None:
    turned = angles_of(log_of(drive((0, 10, 2.0))).runs[0])
    left, right = turned.angles(np.array([0.0, 5.0, 9.0]))
    assert np.allclose(left, [0, 10, 18])
    assert np.allclose(right, [0, -10, -18])


def test_nothing_is_known_of_a_gap() -> None:
    turned = angles_of(log_of(drive((0, 5, 2.0), (8, 10, 2.0))).runs[0])
    assert turned.gaps.shape == (1, 2)
    left, _ = turned.angles(np.array([4.99, 8.0]))
    assert left[0] == left[1]


def test_no_stretch_across_a_gap_is_inside() -> None:
    holes = gaps(np.concatenate((np.arange(0, 5, 0.1), np.arange(7, 9, 0.1))))
    begin, end = np.array([1.0, 4.0, 5.5, 7.5]), np.array([2.0, 6.0, 6.5, 8.0])
    assert inside(begin, end, holes).tolist() == [True, False, False, True]


def test_a_rest_is_where_all_wheels_stand_long_enough() -> None:
    run = log_of(drive((0, 2, 0.0), (2, 4, 1.0), (4, 4.5, 0.0), (4.5, 6, 1.0), (6, 8, 0.01))).runs[
        0
    ]
    found = rests(run, 1.0, 0.2)
    assert np.allclose(found, [[0.2, 1.79], [6.2, 7.79]], atol=0.02)


def test_blocks_leave_out_standstills_and_gaps() -> None:
    runs = log_of(drive((0, 100, 0.0), (100, 140, 1.0), (160, 200, 1.0))).runs
    angles = [angles_of(run) for run in runs]
    parts = blocks(runs, angles, 4.0)
    assert 14 <= len(parts) <= 18
    assert all(part.end > 100 and not part.begin < 150 < part.end for part in parts)
