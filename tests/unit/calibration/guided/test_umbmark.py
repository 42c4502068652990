"""Tests of UMBmark squares and of the distances between their ends and their starts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from acsard.calibration.guided import umbmark
from acsard.calibration.guided.legs import Ask
from tests.unit.calibration.cut import IDEAL
from tests.unit.calibration.guided.played import Player, play, usual_setup
from tests.unit.calibration.robots import SEPARATION, Robot


class Exact(Player):
    """A person who notes where the squares of a robot without noise ended."""

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self.ends: list[complex] = []

    def answer(self, ask: Ask) -> float:
        if "left of its marks" in ask.words:
            self.ends.append(self.place)
        return super().answer(ask)


def test_for_small_errors_it_is_what_borenstein_and_feng_have() -> None:
    """Compare with the equations for E_d and E_b of Borenstein and Feng.

    They use the mean ends of left and right squares.

    Their nominal robot is one whose squares would close: it has equal wheels and the track that was
    used to command the turns.
    """
    robot = replace(Robot(chi=1.3, left=0.999, right=1.001), **IDEAL)  # type: ignore[arg-type]
    player = Exact(robot)
    found = play(umbmark.way(usual_setup()), player).found
    side = umbmark.length(usual_setup())
    left, right = player.ends
    # Left is counter-clockwise. In the frame of their paper the first side is along x, and y is to
    # the left.
    beta = (right.real - left.real) / (-4 * side)
    ratio = math.tan(beta / 2) * SEPARATION * 1.3 / side
    assert found.values[2] / found.values[1] - 1 == pytest.approx(2 * ratio, abs=1.2e-3)


def test_two_squares_close_enough_to_be_measured() -> None:
    rng = np.random.default_rng(4)
    player = Exact(Robot(chi=1.8, rng=rng))
    play(umbmark.way(usual_setup()), player)
    assert max(map(abs, player.ends)) < 0.8
