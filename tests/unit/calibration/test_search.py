"""The search must end near the truth from any configured track and with any sign."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acsard.calibration.fit import DELAY, INVERSE_TRACK, LEFT, RIGHT, Base
from acsard.calibration.positions import segments
from acsard.calibration.runs import blocks
from acsard.calibration.search import StartingPoint, search
from tests.unit.calibration.cut import BASE, log_of, table, usual
from tests.unit.calibration.robots import Drive, Floats, Plan, Robot, drive


def begun(seen: Drive, base: Base = BASE, sides: Floats | None = None) -> StartingPoint:
    runs = log_of(table(seen, gyro=False)).runs
    return search(segments(runs, blocks(runs, 8.0)), runs, base, sides)


@pytest.mark.variations(3)
@pytest.mark.parametrize("separation", [0.15, 0.3, 0.9])
@pytest.mark.parametrize("radius", [0.02, 0.05, 0.2])
def test_it_begins_near_the_truth(separation: float, radius: float) -> None:
    found = begun(usual(), Base(radius, separation, 1.0, 1.0, 1.0))
    assert found.unexplained < 0.05
    assert found.parameters[LEFT] == pytest.approx(0.05 / radius, rel=0.1)
    assert found.parameters[INVERSE_TRACK] == pytest.approx(separation / 0.5, rel=0.15)


def test_a_reversed_side_and_a_mirrored_path_show_in_the_signs() -> None:
    seen = usual()
    left, mirrored = replace(seen, left=-seen.left), replace(seen, place=seen.place.conj())
    found = begun(left).parameters
    one = np.sign(found[[LEFT, RIGHT]] * found[INVERSE_TRACK])
    assert one.tolist() == [-1.0, 1.0]
    assert begun(mirrored).parameters[INVERSE_TRACK] < 0


def test_late_positions_are_found() -> None:
    seen = usual()
    late = replace(seen, place_t=seen.place_t + 0.9)
    assert begun(late).parameters[DELAY] == pytest.approx(0.9, abs=0.15)


def squares(chi: float) -> Plan:
    """Return a plan of squares to both sides.

    The turns in place are 90 deg for a robot with this track ratio.
    """
    side = [(5, 0.4, 0), (0.5, 0, 0), (4, 0, np.pi / 2 * chi / 4), (0.5, 0, 0)]
    return [(3, 0, 0), *side * 8, *[(seconds, v, -w) for seconds, v, w in side * 8]]


@pytest.mark.variations(2)
@pytest.mark.parametrize("chi", [1.3, 1.6, 2.0])
@pytest.mark.parametrize("lever", [0j, 0.1 + 0.1j])
def test_a_turn_in_place_is_taken_for_the_likelier_one(chi: float, lever: complex) -> None:
    """Positions alone cannot distinguish turns of 90 deg left, 270 deg right and 450 deg left."""
    robot = Robot(chi=chi, rate=0.0, lever=lever, slip=0.02)
    seen = drive(robot, squares(chi))
    assert begun(seen).parameters[INVERSE_TRACK] == pytest.approx(1 / chi, rel=0.05)
    mirrored = replace(seen, place=seen.place.conj())
    sides = np.array([1.0, 1.0]) / chi
    assert begun(mirrored, sides=-sides).parameters[INVERSE_TRACK] == pytest.approx(
        -1 / chi, rel=0.05
    )
