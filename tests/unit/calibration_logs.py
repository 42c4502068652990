"""Converts simulated drives to the runs of a log."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from acsard.calibration.fit import Fit, fit
from acsard.calibration.geometry import TRACK
from acsard.calibration.log import Notes, Run, run_of
from acsard.core.config.settings import Config
from tests.unit.calibration_robots import GUIDED, Drive, Floats, Plan, Robot, drive

IDEAL = {
    "rate": 0.0, "slip": 0.0, "late": 0.0, "bias": 0.0, "gyro_noise": 0.0, "place_noise": 0.0,
    "outliers": 0.0, "lever": 0j, "decimals": 6,
}  # fmt: skip
"""Overrides for a robot that moves exactly as the model says and has perfect sensors."""

WAYS = {"gyro": (True, False), "positions": (False, True), "both": (True, True)}
"""Whether the log of a simulated robot has the turn rate of a gyro, and positions."""


def ideal() -> Drive:
    return drive(replace(Robot(), **IDEAL), GUIDED)  # type: ignore[arg-type]


def usual(seed: int = 3, plan: Plan = GUIDED) -> Drive:
    return drive(Robot(rng=np.random.default_rng(seed)), plan)


def run(trip: Drive, *, gyro: bool = True, places: bool = True, name: str = "1") -> Run:
    streams: dict[str, tuple[Floats, ...]] = {"left right": (trip.t, trip.left, trip.right)}
    if gyro:
        streams["yaw_rate"] = trip.gyro_t, trip.gyro
    if places:
        streams["x y"] = trip.place_t, trip.place.real, trip.place.imag
    return run_of(name, streams, Notes())


def by_headings(trip: Drive, late: float) -> Run:
    """Return the drive with headings alone, which are late, s."""
    at = np.arange(trip.t[0] + 0.5, trip.t[-1], 0.1)
    yaw = np.interp(at - late, trip.t, trip.yaw)
    streams = {"left right": (trip.t, trip.left, trip.right), "yaw": (at, yaw)}
    return run_of("1", streams, Notes())


def runs(drives: Iterable[Drive], *, gyro: bool = True, places: bool = True) -> list[Run]:
    return [run(trip, gyro=gyro, places=places, name=str(at)) for at, trip in enumerate(drives, 1)]


def fitted(
    *drives: Drive, gyro: bool = True, places: bool = True, config: Config | None = None
) -> Fit:
    return fit(runs(drives, gyro=gyro, places=places), config or Config())


def multipliers(found: Fit) -> Floats:
    """Return track, left and right as factors of the configured ones."""
    return np.asarray(np.exp(found.p[[TRACK, 0, 1]]))
