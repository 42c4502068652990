"""Tests that prepare a log: it is cut, and the fit starts from nearly right values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acsard.calibration.doubts import RefusedError
from acsard.calibration.evidence import LEFT, RIGHT, TURN
from tests.unit.calibration.cut import ready, usual


@pytest.mark.parametrize(("gyro", "places"), [(True, False), (False, True), (True, True)])
def test_it_begins_near_the_truth(gyro: bool, places: bool) -> None:
    made = ready(usual().csv(gyro=gyro, places=places))
    assert len(made.sources) == gyro + places
    assert made.start[[LEFT, RIGHT]] == pytest.approx([1.0, 1.0], abs=0.05)
    assert 1 / made.start[TURN] == pytest.approx(1.66, abs=0.15)


def test_sensors_of_another_time_are_refused() -> None:
    drive = usual()
    other = replace(drive, place_t=drive.place_t + 1000.0, gyro=np.zeros(0), gyro_t=np.zeros(0))
    with pytest.raises(RefusedError, match="one clock"):
        ready(other.csv(gyro=False))
