"""Tests of the guided calibration with a wall and a tape measure."""

from __future__ import annotations

import pytest

from acsard.calibration.guided import wall
from tests.unit.calibration.guided.played import Player, anyone, play, usual_setup


def test_left_and_right_come_apart_by_what_is_driven_between_two_half_turns() -> None:
    robot = anyone(1)
    robot.left, robot.right = 1.005, 0.995
    found = play(wall.way(usual_setup()), Player(robot)).found
    ratio = found.values[1] / found.values[2]
    assert ratio == pytest.approx(1.01, abs=0.006)


def test_it_stops_short_of_the_wall_it_comes_back_to() -> None:
    setup = usual_setup()
    for leg in (wall.there_and_back(setup, 1, 1.6), wall.spun(setup, 1.6)):
        ways = [move.linear * move.seconds for move in leg.moves if move.linear]
        assert abs(ways[1]) < ways[0] - 0.1
