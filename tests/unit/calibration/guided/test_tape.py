"""Tests of the guided calibration with only a tape measure."""

from __future__ import annotations

import pytest

from acsard.calibration.guided import tape
from acsard.calibration.guided.legs import Ask, GuideError
from tests.unit.calibration.guided.played import Player, anyone, play, usual_setup
from tests.unit.calibration.robots import Robot


class Hasty(Player):
    """A person who ends the first turn after less than half a revolution."""

    def _round_s(self, angular: float) -> float:
        return super()._round_s(angular) / 2.3


def test_a_first_turn_that_was_ended_half_way_is_found_out() -> None:
    with pytest.raises(GuideError, match="one whole turn"):
        play(tape.way(usual_setup()), Hasty(Robot(chi=1.7)))


class Metric(Player):
    """A person in the test, who answers each question and records it."""

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self.asked: list[Ask] = []

    def answer(self, ask: Ask) -> float:
        self.asked.append(ask)
        return super().answer(ask)


def test_short_lengths_are_asked_in_mm_and_the_long_one_in_m() -> None:
    player = Metric(anyone(0))
    play(tape.way(usual_setup()), player)
    assert [ask.unit for ask in player.asked].count("m") == 1
    assert {ask.unit for ask in player.asked} == {"mm", "m"}
