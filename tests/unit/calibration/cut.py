"""Helpers that cut logs into the parts that the calibration modules take."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from acsard.calibration import prepared, solve, wheel_angles
from acsard.calibration import runs as reading
from acsard.calibration.evidence import Base
from acsard.calibration.heading import of_gyro
from acsard.calibration.log_table import read
from acsard.calibration.prepared import Prepared
from acsard.calibration.tape_distance import Tape
from acsard.core.config.settings import DriveConfig
from tests.unit.calibration.robots import GUIDED, Drive, Plan, Robot, drive

BASE = Base(0.05, 0.30, 1.0, 1.0, 1.0)

IDEAL = {
    "rate": 0.0, "slip": 0.0, "late": 0.0, "bias": 0.0, "gyro_noise": 0.0, "place_noise": 0.0,
    "outliers": 0.0, "lever": 0j, "decimals": 6,
}  # fmt: skip
"""Overrides for a robot that moves exactly as the model says and has perfect sensors."""


def ideal(plan: Plan = GUIDED) -> Drive:
    return drive(replace(Robot(), **IDEAL), plan)  # type: ignore[arg-type]


def usual(seed: int = 3, plan: Plan = GUIDED) -> Drive:
    return drive(Robot(rng=np.random.default_rng(seed)), plan)


def log_of(text: str) -> reading.Log:
    return reading.runs(read(text.encode()))


def ready(text: str) -> Prepared:
    runs = log_of(text).runs
    angles = [wheel_angles.angles_of(run) for run in runs]
    return prepared.prepared(runs, angles, of_gyro(runs, angles), BASE, 4.0)


def calibrated(text: str, tape: Tape | None = None) -> solve.Calibration:
    return solve.calibrate(log_of(text), DriveConfig(), tape)
