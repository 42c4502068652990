"""A sensor that does not follow the wheels is refused with the cause that the log shows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from acsard.calibration.log import Log, LogError
from acsard.calibration.result import Result, calibrate
from acsard.core.config.settings import Config
from tests.unit.calibration_logs import run, usual
from tests.unit.calibration_robots import Drive

TRIP = usual()


def result(trip: Drive, *, gyro: bool = True, places: bool = False) -> Result:
    return calibrate(Log((run(trip, gyro=gyro, places=places),), ("a note",)), Config(), "a.csv")


CAUSES: dict[str, tuple[dict[str, Any], str]] = {
    "sign": ({"gyro": -TRIP.gyro}, "yaw_rate turns to the other side"),
    "deg/s": ({"gyro": np.degrees(TRIP.gyro)}, "is yaw_rate in rad/s"),
    "rpm": (
        {"left": TRIP.left * 9.55, "right": TRIP.right * 9.55},
        "speeds of the wheels in rad/s",
    ),
    "swapped": ({"left": TRIP.right, "right": TRIP.left}, "left and right are swapped"),
    "one side": ({"left": TRIP.right}, "left and right are the same in every row"),
    "no sign": ({"left": abs(TRIP.left), "right": abs(TRIP.right)}, "never turn backwards"),
    "another": ({"gyro": TRIP.gyro[::-1]}, "does not follow the wheels"),
    "no motion": ({"left": TRIP.left * 0.0, "right": TRIP.right * 0.0}, "the wheels roll only 0.0"),
}


@pytest.mark.parametrize("kind", CAUSES)
def test_the_cause_is_named(kind: str) -> None:
    changed, words = CAUSES[kind]
    with pytest.raises(LogError) as refused:
        result(replace(TRIP, **changed))
    assert words in str(refused.value)
    assert refused.value.__notes__ == ["a note"]


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (TRIP.place.conj(), "y must point to the left"),
        pytest.param(TRIP.place * 1000.0, "are x and y in m", marks=pytest.mark.slow),
        pytest.param(TRIP.place[::-1], "x, y does not follow the wheels", marks=pytest.mark.slow),
    ],
)
def test_the_cause_of_positions_is_named(place: Any, words: str) -> None:
    with pytest.raises(LogError) as refused:
        result(replace(TRIP, place=place), gyro=False, places=True)
    assert words in str(refused.value)


@pytest.mark.slow
def test_a_sound_log_has_no_note_of_its_own() -> None:
    assert result(TRIP, places=True).notes == ("a note",)


def test_a_sensor_that_was_computed_from_the_wheels_is_noted() -> None:
    rate = (TRIP.right - TRIP.left) * 0.05 / 0.45
    made = result(replace(TRIP, gyro_t=TRIP.t, gyro=rate))
    assert any("yaw_rate agrees with the wheels better than a sensor can" in n for n in made.notes)
