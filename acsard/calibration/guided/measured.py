"""Turns tape readings into a calibration: settings, improvement and a summary of the drives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from acsard.calibration import heading
from acsard.calibration.doubts import remarks
from acsard.calibration.evidence import RATE, TURN, Base
from acsard.calibration.fit import Rates, configured, constant, rates
from acsard.calibration.gain import Error, Gain
from acsard.calibration.gain import constant as with_one_track
from acsard.calibration.guided.readings import Found, Reading, found, joined, predicted
from acsard.calibration.log_table import Floats
from acsard.calibration.paths import blocks, wheels
from acsard.calibration.prepared import sure_enough
from acsard.calibration.solve import Calibration, Drives
from acsard.core.config.settings import DriveConfig

BLOCK_S = 4.0

WORST = 0.1, 0.02
"""Largest useful standard deviations, as fractions: of the track, and of the ratio of radii."""

MEND = (
    "they contradict each other, or the robot skids much. Start again on even ground, place the "
    "robot exactly, and measure to the millimetre"
)

TURNED, STRAIGHT = np.pi, 0.5
"""Turns that classify a reading, rad.

Above `TURNED` it counts as a reading of turns, and below `STRAIGHT` as one of a straight drive.
"""


def calibrated(way: str, readings: Sequence[Reading], drive: DriveConfig) -> Calibration:
    """Return the calibration that the readings give. Raises `RefusedError`."""
    base = Base.of(drive)
    rides = list({id(ride): ride for reading in readings for ride in reading.rides}.values())
    told = found(readings, base)
    angles = [wheels(ride) for ride in rides]
    rows = heading.rows(None, rides, angles, blocks(rides, angles, BLOCK_S))
    by_wheels = heading.turned(rows, base, told.parameters)
    rate = rates(rows, by_wheels)
    result = constant(told.parameters, told.covariance, rate, 0.0)
    chance = float(np.sqrt(told.covariance[TURN, TURN])) / abs(told.parameters[TURN])
    sure_enough(result, chance, WORST, "these readings", MEND)
    drives = Drives.of(rides, rows, by_wheels, base, result, rate)
    now = told.parameters.copy()
    now[: RATE + 1] = base.start()[: RATE + 1]
    notes = remarks({}, 0.0, by_wheels, result.values, base, sized=True)
    return Calibration(
        way, drives, configured(base), result, "distance", float(told.parameters[RATE]),
        float(np.sqrt(told.covariance[RATE, RATE])), _gain(readings, base, told, now, rate),
        {}, 0.0, tuple(notes),
    )  # fmt: skip


def _gain(readings: Sequence[Reading], base: Base, told: Found, now: Floats, rate: Rates) -> Gain:
    """Return the errors of each reading, predicted with the parameters found without it."""
    sums = {name: np.zeros(3) for name in ("turn", "straight", "place")}
    one = with_one_track(told.parameters, rate)
    for number, reading in enumerate(readings):
        steps = joined(reading.rides)
        then = predicted(steps, reading.what, base, told.parameters).value
        truth = then + told.left[number]
        off = truth - predicted(steps, reading.what, base, now).value
        # The robot uses one track for all turn rates.
        moved = predicted(steps, reading.what, base, one).value - then
        rest = told.without[number] - moved
        if np.isnan(rest):
            rest = told.left[number] - moved
        turn = abs(predicted(steps, "turned", base, told.parameters).value)
        if reading.what in ("turned", "angle"):
            if turn > TURNED:
                sums["turn"] += abs(off), abs(rest), turn
            elif turn < STRAIGHT:
                rolled = abs(predicted(steps, "distance", base, told.parameters).value)
                sums["straight"] += abs(off), abs(rest), rolled
        elif reading.what in ("ahead", "aside"):
            sums["place"] += off**2, rest**2, 1.0
    return Gain(
        _error(sums["turn"], 360.0), _error(sums["straight"], float(np.degrees(10.0))),
        _rms(sums["place"]),
    )  # fmt: skip


def _error(sums: Floats, unit: float) -> Error:
    if not sums[2]:
        return Error(None, None)
    return Error(float(unit * sums[0] / sums[2]), float(unit * sums[1] / sums[2]))


def _rms(sums: Floats) -> Error:
    if not sums[2]:
        return Error(None, None)
    return Error(float(np.sqrt(sums[0] / sums[2])), float(np.sqrt(sums[1] / sums[2])))
