"""The search has to end near enough, from any configured track and with any sign."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acsard.calibration.evidence import LATE, LEFT, RIGHT, TURN, Base
from acsard.calibration.paths import blocks, wheels
from acsard.calibration.places import spots
from acsard.calibration.search import Begin, search
from tests.unit.calibration.cut import BASE, log_of, usual
from tests.unit.calibration.robots import Drive


def begun(drive: Drive, base: Base = BASE) -> Begin:
    runs = log_of(drive.csv(gyro=False)).runs
    angles = [wheels(run) for run in runs]
    return search(spots(runs, angles, blocks(runs, angles, 8.0)), runs, angles, base)


@pytest.mark.variations(3)
@pytest.mark.parametrize("separation", [0.15, 0.3, 0.9])
@pytest.mark.parametrize("radius", [0.02, 0.05, 0.2])
def test_it_begins_near_the_truth(separation: float, radius: float) -> None:
    found = begun(usual(), Base(radius, separation, 1.0, 1.0, 1.0))
    assert found.unexplained < 0.05
    assert found.parameters[LEFT] == pytest.approx(0.05 / radius, rel=0.1)
    assert found.parameters[TURN] == pytest.approx(separation / 0.5, rel=0.15)


def test_a_reversed_side_and_a_mirrored_path_show_in_the_signs() -> None:
    drive = usual()
    left, mirrored = replace(drive, left=-drive.left), replace(drive, place=drive.place.conj())
    one = np.sign(begun(left).parameters[[LEFT, RIGHT]] * begun(left).parameters[TURN])
    assert one.tolist() == [-1.0, 1.0]
    assert begun(mirrored).parameters[TURN] < 0


def test_late_positions_are_found() -> None:
    drive = usual()
    late = replace(drive, place_t=drive.place_t + 0.9)
    assert begun(late).parameters[LATE] == pytest.approx(0.9, abs=0.15)
