"""Helpers that convert drives and logs to the inputs of the calibration modules."""

from __future__ import annotations

from collections.abc import Callable, Iterable
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


def table(trip: Drive, *, gyro: bool = True, places: bool = True) -> Table:
    """Return the table that `read` would make of the drive's CSV text, without writing the text.

    `test_a_table_made_directly_equals_that_of_the_written_log` compares both tables.
    """
    sensors = [
        (trip.t, {"left": trip.left, "right": trip.right}, 2, True),
        (trip.gyro_t, {"yaw_rate": trip.gyro}, 6, gyro),
        (trip.place_t, {"x": trip.place.real, "y": trip.place.imag}, 4, places),
    ]
    made = Table.joined(
        [
            {"t": np.round(t[: len(t) * used], 6)}
            | {name: np.round(sensed[: len(t) * used], decimals) for name, sensed in values.items()}
            for t, values, decimals, used in sensors
        ]
    )
    return structs.replace(made, notes=tuple(bounded(made.columns)))


def log_of(log: str | Table) -> reading.Log:
    """Return the runs of a log, given as text or as a table."""
    return reading.runs(read(log.encode()) if isinstance(log, str) else log)


def log_of_runs(
    drives: Iterable[Drive], *, gyro: bool = True, places: bool = True,
    recorded: Callable[..., Table] = table,
) -> reading.Log:  # fmt: skip
    """Return a log in which each drive is a run. `recorded` converts a drive to a table."""
    runs = [log_of(recorded(trip, gyro=gyro, places=places)).runs[0] for trip in drives]
    named = [structs.replace(run, name=str(at + 1)) for at, run in enumerate(runs)]
    return reading.Log(tuple(named), ())


def ready(log: str | Table) -> Prepared:
    runs = log_of(log).runs
    return prepared(runs, of_gyro(runs), BASE, 4.0)


def calibrated(log: str | Table | reading.Log, tape: Tape | None = None) -> solve.Calibration:
    data = log if isinstance(log, reading.Log) else log_of(log)
    return solve.calibrate(data, DriveConfig(), tape)
