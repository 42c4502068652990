"""The path of the last minutes is thinned and bounded, and restarts when the pose was set."""

from __future__ import annotations

import itertools

from acsard.values import NS_PER_S
from acsard.web.trail import LASTS_NS, POINTS, STEP_M, Trail


def test_a_robot_that_stands_is_one_point() -> None:
    trail = Trail()
    for n in range(1000):
        trail.add(n * NS_PER_S // 10, 1.0, 2.0)
    assert trail.points() == [(1.0, 2.0)]


def test_points_are_a_step_apart_and_keep_the_way() -> None:
    trail = Trail()
    for n in range(1001):
        trail.add(n, n / 1000, 0.0)
    points = trail.points()
    assert points[0] == (0.0, 0.0)
    assert points[-1][0] > 1.0 - 1.1 * STEP_M
    gaps = [b[0] - a[0] for a, b in itertools.pairwise(points)]
    assert min(gaps) > 0.99 * STEP_M


def test_it_is_bounded_in_points_and_in_time() -> None:
    trail = Trail()
    for n in range(3 * POINTS):
        trail.add(n, n * 0.5, 0.0)
    assert len(trail.points()) == POINTS
    trail.add(3 * POINTS + 2 * LASTS_NS, 3 * POINTS * 0.5, 0.0)
    assert len(trail.points()) == 1


def test_a_pose_that_was_set_begins_it_anew() -> None:
    trail = Trail()
    for n in range(10):
        trail.add(n, 0.1 * n, 0.0)
    trail.add(10, 50.0, 0.0)
    assert trail.points() == [(50.0, 0.0)]
