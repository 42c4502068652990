"""Tests that turn tape readings into a calibration."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.calibration_report import keys, parts, report
from acsard.calibration.guided.tape_calibration import calibrated
from acsard.calibration.guided.tape_readings import Reading
from acsard.calibration.plausibility import RefusedError
from acsard.core.config.parsing import parse
from acsard.core.config.settings import DriveConfig
from acsard.core.config.writing import excerpt
from acsard.terminal.output import plain
from tests.unit.calibration.guided.test_tape_readings import readings

DRIVE = DriveConfig()


def test_errors_are_those_of_what_is_configured_and_of_what_was_found() -> None:
    made = calibrated("a tape", readings(), DRIVE)
    assert made.improvement.turn.before == pytest.approx(180, rel=0.05)
    assert made.improvement.turn.after is not None
    assert made.improvement.turn.after < 10
    assert made.drives.runs == 3
    assert made.drives.turns == pytest.approx(15 * 1.2 / 1.5 / 2 / np.pi, rel=0.15)


def test_people_read_it_and_the_configuration_takes_it() -> None:
    made = calibrated("a tape", readings(), DRIVE)
    told = plain(*parts(report("the drive", made, DRIVE, ""), made, "acsard.toml"))
    assert "compared with a tape" in told
    assert "error of a turn of 360 deg" in told
    config = parse("\n".join(excerpt(keys(made))).encode())
    assert config.drive.wheel_separation_multiplier == pytest.approx(1.5, rel=0.02)
    assert 0 < config.odometry.wheel_separation_multiplier_std < 0.2


def test_readings_that_tell_too_little_are_refused() -> None:
    vague = [Reading(one.rides, one.quantity, one.value, 100 * one.deviation) for one in readings()]
    with pytest.raises(RefusedError, match="too inaccurate"):
        calibrated("a tape", vague, DRIVE)
