"""Tests of a guided calibration whose legs are disturbed and repeated."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.guided.drive_plan import DisturbedError, Leg
from acsard.calibration.guided.methods import METHODS
from acsard.calibration.guided.runner import (
    MAX_REPEATS,
    MAX_SIMULATED_REPEATS,
    begins_again,
    guide,
)
from acsard.calibration.runs import Run
from acsard.calibration.solve import Calibration
from tests.each import each
from tests.unit.calibration.guided.played import PlayedPrompt, Player, anyone, usual_setup

SET_BACK_RAD = 0.3
"""Error with which the person sets the robot back."""


@each(
    ("way", "leg", "again"),
    [
        ("gyro", "turns", "turns"), ("positions", "turns", "turns"), ("tape", "ahead", "ahead"),
        ("tape", "once round", "ahead"), ("tape", "slowly", "slowly"), ("tape", "fast", "fast"),
    ],
)  # fmt: skip
def test_a_drive_resumes_at_the_last_leg_whose_measurement_stands_alone(
    way: str, leg: str, again: str
) -> None:
    method = METHODS[way]
    legs = method.legs(usual_setup(), 1.6)
    number = [stage.name for stage in legs].index(leg)
    assert legs[begins_again(legs, number, sensor=not method.by_tape)].name == again


class Disturbed:
    """A guided calibration in which one leg is disturbed half-way, the first `times` times."""

    def __init__(self, way: str, leg: str, times: int) -> None:
        self._way, self._leg, self._left = way, leg, times
        self.player = Player(anyone(5), gyro=way == "gyro", places=way == "positions")
        self.prompt = PlayedPrompt(self.player)
        self.driven: list[str] = []

    def ride(self, leg: Leg) -> Run:
        self.driven.append(leg.name)
        if leg.name == self._leg and self._left:
            self._left -= 1
            self.player.yaw += SET_BACK_RAD
            raise DisturbedError("a person stood in the way", "stopped")
        return self.player.ride(leg)

    def calibrate(self, *, simulated: bool = False) -> Calibration:
        return guide(self._way, usual_setup(), self.prompt, self.ride, simulated=simulated)


@pytest.mark.parametrize(
    ("way", "leg"),
    [("gyro", "turns"), ("tape", "slowly"), ("tape", "once round")],
)
def test_a_disturbed_leg_is_repeated_and_the_result_is_right(
    way: str, leg: str, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = Disturbed(way, leg, MAX_REPEATS)
    values = drive.calibrate().multipliers.values
    expected = Disturbed(way, leg, 0).calibrate().multipliers
    robot = drive.player.robot
    assert drive.driven.count(leg) == 1 + MAX_REPEATS
    assert values[0] == pytest.approx(robot.chi * (1 + 0.5 * robot.rate), rel=0.05)
    assert np.all(np.abs(values - expected.values) < 4 * expected.std)
    output = " ".join(capsys.readouterr().err.split())
    assert "was disturbed: a person stood in the way" in output
    assert "put the robot back" in output


def test_a_leg_that_is_disturbed_three_times_ends_the_drive() -> None:
    drive = Disturbed("gyro", "turns", MAX_REPEATS + 1)
    with pytest.raises(DisturbedError, match="stopped"):
        drive.calibrate()
    assert drive.driven == ["straight", *["turns"] * (MAX_REPEATS + 1)]


def test_on_the_simulator_a_leg_is_repeated_more_often_without_putting_it_back(
    capsys: pytest.CaptureFixture[str],
) -> None:
    drive = Disturbed("gyro", "turns", MAX_SIMULATED_REPEATS)
    assert drive.calibrate(simulated=True).multipliers.values[0] > 0.9
    assert "put the robot back" not in capsys.readouterr().err
