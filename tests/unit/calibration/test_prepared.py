"""Tests that prepare a log: it is cut, it must have enough movement, and the fit starts near."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as replace_fit

from acsard.calibration.evidence import INVERSE_TRACK, LEFT, RIGHT
from acsard.calibration.fit import Multipliers, fit
from acsard.calibration.heading import Rows
from acsard.calibration.plausibility import RefusedError
from acsard.calibration.prepared import (
    DRIVE,
    RATIO,
    TRACK,
    drives_enough,
    rolls_enough,
    separates_track,
    turns_enough,
    unsure,
)  # fmt: skip
from acsard.calibration.wheel_angles import Block
from tests.unit.calibration.cut import ready, table, usual


@pytest.mark.parametrize(("gyro", "places"), [(True, False), (False, True), (True, True)])
def test_it_begins_near_the_truth(gyro: bool, places: bool) -> None:
    made = ready(table(usual(), gyro=gyro, places=places))
    assert len(made.sources) == gyro + places
    assert made.start[[LEFT, RIGHT]] == pytest.approx([1.0, 1.0], abs=0.05)
    assert 1 / made.start[INVERSE_TRACK] == pytest.approx(1.66, abs=0.15)


def test_sensors_of_another_time_are_refused() -> None:
    drive = usual()
    other = replace(drive, place_t=drive.place_t + 1000.0, gyro=np.zeros(0), gyro_t=np.zeros(0))
    with pytest.raises(RefusedError, match="one clock"):
        ready(table(other, gyro=False))


def rows(left: list[float], right: list[float]) -> Rows:
    one = np.ones(len(left))
    return Rows(one.astype(np.int64), one, np.array(left), np.array(right), one, one)


def test_turns_and_straight_drives_are_enough() -> None:
    rolls_enough(rows([9, -9, 9, -9], [9, -9, -9, 9]))
    turns_enough(np.full(10, 1.0))
    drives_enough([Block(0, 0, 4)] * 5)
    assert not unsure(Multipliers(np.array([1.6, 1, 1]), np.eye(3) * 1e-5), 0.01)


@pytest.mark.parametrize(
    ("left", "right"),
    [([9, 9, 9], [9, 9, 9]), ([9, -9, 9], [-9, 9, -9]), ([5, 5, 5], [15, 15, 15])],
)
def test_one_movement_only_is_refused_with_what_to_drive(
    left: list[float], right: list[float]
) -> None:
    with pytest.raises(RefusedError) as refused:
        rolls_enough(rows(left, right))
    assert DRIVE in str(refused.value)


def test_little_of_it_is_refused() -> None:
    with pytest.raises(RefusedError, match="57 deg"):
        turns_enough(np.array([0.5, -0.5]))
    with pytest.raises(RefusedError, match="only 8 s"):
        drives_enough([Block(0, 0, 4)] * 2)


def test_turns_on_the_spot_are_enough_for_a_heading_sensor() -> None:
    spins = rows([-9, 9, -9], [9, -9, 9])
    rolls_enough(spins, spins=True)
    with pytest.raises(RefusedError, match="ahead or back"):
        rolls_enough(spins)


def test_what_is_unsure_is_named_with_its_deviation() -> None:
    apart = Multipliers(np.array([1.6, 1, 1]), np.diag([0, 1e-3, 1e-3]))
    assert unsure(apart, 0.01) == {RATIO: pytest.approx(0.0447, abs=1e-4)}
    assert TRACK in unsure(Multipliers(np.array([1.6, 1, 1]), np.eye(3) * 1e-6), np.nan)


def test_turns_while_driving_ahead_only_do_not_separate_the_wheels() -> None:
    made = ready(table(usual(), places=False))
    fitted = fit(made.sources, made.start, places=False)
    assert separates_track(fitted)
    alike = np.zeros_like(fitted.normal)
    alike[:, :3, :3] = 1.0
    assert not separates_track(replace_fit(fitted, normal=alike))
