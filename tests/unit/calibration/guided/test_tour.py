"""Tests of the guided calibration with a gyro or with positions."""

from __future__ import annotations

from dataclasses import replace

import pytest

from acsard.calibration.doubts import RefusedError
from acsard.calibration.guided import tour
from acsard.calibration.guided.legs import Ask
from acsard.calibration.log_table import LogError
from tests.unit.calibration.guided.played import Player, anyone, play, usual_setup


class Blind(Player):
    """A person without a tape, who answers each question with its default."""

    def answer(self, ask: Ask) -> float:
        assert ask.usual is not None
        return ask.usual


def test_a_tape_beside_the_gyro_measures_the_wheels() -> None:
    robot = replace(anyone(3), left=0.95, right=0.952)
    found = play(tour.gyro(usual_setup()), Player(robot, gyro=True))
    assert found.scale == "distance"
    assert found.found.values[1] == pytest.approx(0.95, rel=0.02)


def test_without_a_tape_the_size_of_the_wheels_stays_as_configured() -> None:
    found = play(tour.gyro(usual_setup()), Blind(anyone(3), gyro=True))
    assert found.scale == ""
    assert found.found.values[1:].mean() == pytest.approx(1.0, abs=1e-6)


def test_a_gyro_that_says_one_and_the_same_is_refused() -> None:
    robot = replace(anyone(3), gyro_noise=0.0, gyro_hz=0.001)
    with pytest.raises((LogError, RefusedError), match=r"gyro|record"):
        play(tour.gyro(usual_setup()), Blind(robot, gyro=True))


def test_every_curve_is_driven_back() -> None:
    for leg in (tour.spins(usual_setup()), tour.petals(usual_setup())):
        curves = [move for move in leg.moves if move.linear and move.angular]
        assert sum(move.angular * move.seconds for move in curves) == pytest.approx(0.0)
        assert sum(move.linear * move.seconds for move in curves) == pytest.approx(0.0)
