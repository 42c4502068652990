"""A tape measurement determines the size of the wheels."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.log_table import NoCalibrationError
from acsard.calibration.multipliers import RUN_LENGTH_STD_M, Extent, Multipliers, Tape, scaled

FOUND = Multipliers(np.array([1.6, 1.0, 1.0]), np.diag([0.02, 1e-3, 1e-3]) ** 2)
NAMES = ("turns", "straight")


def follow(values: np.ndarray, number: int) -> Extent:
    """Return the extent of a path of 5 m, or of a path of 9 m that ends near its start.

    Both grow with the wheels' size in `values`.
    """
    size = float(values[1:].mean())
    return Extent(5.0 * size, 5.0 * size) if number else Extent(0.1 * size, 9.0 * size)


def test_the_tape_changes_only_the_scale() -> None:
    made, run = scaled(FOUND, Tape(5.1), NAMES, follow, known=False)
    assert run == "straight"
    assert made.values == pytest.approx(FOUND.values * 1.02, rel=1e-4)
    assert made.std[1] / made.values[1] == pytest.approx(
        np.hypot(RUN_LENGTH_STD_M / 5.1, 7e-4), rel=0.2
    )


def test_a_tape_hardly_changes_the_scale_of_accurate_positions() -> None:
    sure = Multipliers(FOUND.values, FOUND.covariance * 1e-6)
    made, _ = scaled(sure, Tape(5.1), NAMES, follow, known=True)
    assert made.values == pytest.approx(FOUND.values, rel=1e-3)


@pytest.mark.parametrize("metres", [2.5, 4.8, 5.2, 10.0])
def test_a_tape_that_contradicts_the_positions_is_refused(metres: float) -> None:
    with pytest.raises(NoCalibrationError, match=r"ends 5\.00 m from its start, but you measured"):
        scaled(FOUND, Tape(metres), NAMES, follow, known=True)


@pytest.mark.parametrize(("run", "words"), [("turns", "from its start"), ("no", "no run")])
def test_a_missing_run_or_one_that_ends_near_its_start_is_refused(run: str, words: str) -> None:
    with pytest.raises(NoCalibrationError, match=words):
        scaled(FOUND, Tape(5.0, run), NAMES, follow, known=False)
