"""Helpers that cut logs into the parts that the calibration modules take."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from msgspec import structs

from acsard.calibration import runs as reading
from acsard.calibration import solve
from acsard.calibration.fit import Base
from acsard.calibration.heading import of_gyro
from acsard.calibration.log_table import Table, bounded, read
from acsard.calibration.multipliers import Tape
from acsard.calibration.solve import Prepared, prepared
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


def table(seen: Drive, *, gyro: bool = True, places: bool = True) -> Table:
    """Return the table that `read` makes of `seen.csv`, without the time for writing and reading.

    `test_a_table_is_that_of_the_written_log` compares both.
    """
    counts = len(seen.t), len(seen.gyro_t) * gyro, len(seen.place_t) * places
    ends = np.cumsum([0, *counts])
    cells = np.full((6, ends[-1]), np.nan)
    sensors = (
        (seen.t, {1: seen.left, 2: seen.right}, 2),
        (seen.gyro_t, {3: seen.gyro}, 6),
        (seen.place_t, {4: seen.place.real, 5: seen.place.imag}, 4),
    )
    for begin, count, (times, values, decimals) in zip(ends, counts, sensors, strict=False):
        rows = slice(begin, begin + count)
        cells[0, rows] = np.round(times[:count], 6)
        for column, sensed in values.items():
            cells[column, rows] = np.round(sensed[:count], decimals)
    cells = cells[:, np.argsort(cells[0], kind="stable")]
    columns = dict(zip(("t", "left", "right", "yaw_rate", "x", "y"), cells, strict=True))
    return Table(columns, np.zeros(ends[-1], np.int64), ("",), tuple(bounded(columns)))


def log_of(log: str | Table) -> reading.Log:
    """Return the runs of a log, given as text or as a table."""
    return reading.runs(read(log.encode()) if isinstance(log, str) else log)


def log_of_runs(drives: Iterable[Drive], *, gyro: bool = True, places: bool = True) -> reading.Log:
    """Return a log in which each drive is a run."""
    runs = [log_of(table(seen, gyro=gyro, places=places)).runs[0] for seen in drives]
    named = [structs.replace(run, name=str(at + 1)) for at, run in enumerate(runs)]
    return reading.Log(tuple(named), ())


def ready(log: str | Table) -> Prepared:
    runs = log_of(log).runs
    return prepared(runs, of_gyro(runs), BASE, 4.0)


def calibrated(log: str | Table | reading.Log, tape: Tape | None = None) -> solve.Calibration:
    found = log if isinstance(log, reading.Log) else log_of(log)
    return solve.calibrate(found, DriveConfig(), tape)
