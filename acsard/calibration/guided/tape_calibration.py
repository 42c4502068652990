"""Turns tape readings into a `Calibration`: settings, improvement and a summary of the drives."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from acsard.calibration import heading
from acsard.calibration.evidence import INVERSE_TRACK, TRACK_GROWTH, Base
from acsard.calibration.fit import Rates, configured, multipliers, rates
from acsard.calibration.guided.tape_readings import (
    Reading,
    TapeFit,
    fit_readings,
    joined,
    predicted,
)
from acsard.calibration.improvement import NOTHING, BeforeAfter, Improvement, with_constant_track
from acsard.calibration.log_table import Floats
from acsard.calibration.plausibility import RefusedError, remarks
from acsard.calibration.prepared import unsure
from acsard.calibration.solve import Calibration, Drives
from acsard.calibration.wheel_angles import angles_of, blocks
from acsard.core.config.settings import DriveConfig

WORST = 0.1, 0.02
"""Largest useful standard deviations, as fractions: of the track, and of the ratio of radii."""

ADVICE = (
    "they contradict each other, or the robot skids much. Start again on even ground, place the "
    "robot exactly, and measure to the millimetre"
)

TURNED, STRAIGHT = np.pi, 0.5
"""A drive that turned by more than `TURNED` rad is a turn, by less than `STRAIGHT` rad a straight.

The heading error of a drive in between belongs to neither.
"""


def calibrated(tool: str, readings: Sequence[Reading], drive: DriveConfig) -> Calibration:
    """Return the calibration that the readings give. Raises `RefusedError`.

    `tool` names the tool of the measurements in words.
    """
    base = Base.of(drive)
    rides = list({id(ride): ride for reading in readings for ride in reading.rides}.values())
    fit = fit_readings(readings, base)
    angles = [angles_of(ride) for ride in rides]
    # No gyro is compared, so the blocks only have to be short enough to show the turn rates.
    rows = heading.rows(None, rides, angles, blocks(rides, angles, 4.0))
    by_wheels = heading.turned(rows, base, fit.parameters)
    rate = rates(rows, by_wheels)
    result = multipliers(fit.parameters, fit.covariance, rate)
    inverse_track, std = fit.parameters[INVERSE_TRACK], np.sqrt(np.diag(fit.covariance))
    chance = float(std[INVERSE_TRACK] / abs(inverse_track))
    for name, deviation in unsure(result, chance, WORST).items():
        raise RefusedError(
            f"these readings determine {name} only to {deviation:.1%}, which is too inaccurate: "
            f"{ADVICE}"
        )
    drives = Drives.of(rides, rows, by_wheels, base, result, rate)
    notes = remarks({}, 0.0, by_wheels, result.values, base, sized=True)
    return Calibration(
        reference=tool, drives=drives, configured=configured(base), multipliers=result,
        scale="distance", growth=float(fit.parameters[TRACK_GROWTH]),
        growth_std=float(std[TRACK_GROWTH]), improvement=_improvement(readings, base, fit, rate),
        delays={}, gyro_bias=0.0, notes=tuple(notes),
    )  # fmt: skip


def _improvement(readings: Sequence[Reading], base: Base, fit: TapeFit, rate: Rates) -> Improvement:
    """Return the errors of the readings with the configured and with the found parameters.

    The error after the calibration is that of a fit without the reading itself.
    """
    sums = {name: np.zeros(3) for name in ("turn", "straight", "place")}
    present = fit.parameters.copy()
    present[: TRACK_GROWTH + 1] = base.start()[: TRACK_GROWTH + 1]
    constant = with_constant_track(fit.parameters, rate)
    for number, reading in enumerate(readings):
        steps = joined(reading.rides)
        fitted = predicted(steps, reading.quantity, base, fit.parameters).value
        truth = fitted + fit.residuals[number]
        before = truth - predicted(steps, reading.quantity, base, present).value
        residual = fit.residuals[number] if np.isnan(fit.held_out[number]) else fit.held_out[number]
        # The robot uses one track for all turn rates, unlike the fit.
        after = residual - (predicted(steps, reading.quantity, base, constant).value - fitted)
        turn = abs(predicted(steps, "turned", base, fit.parameters).value)
        if reading.quantity in ("turned", "angle"):
            if turn > TURNED:
                sums["turn"] += abs(before), abs(after), turn
            elif turn < STRAIGHT:
                rolled = abs(predicted(steps, "distance", base, fit.parameters).value)
                sums["straight"] += abs(before), abs(after), rolled
        elif reading.quantity in ("ahead", "aside"):
            sums["place"] += before**2, after**2, 1.0
    return Improvement(
        _per_amount(sums["turn"], 360.0), _per_amount(sums["straight"], float(np.degrees(10.0))),
        NOTHING, _rms(sums["place"]),
    )  # fmt: skip


def _per_amount(sums: Floats, unit: float) -> BeforeAfter:
    before, after, amount = sums.tolist()
    if not amount:
        return NOTHING
    return BeforeAfter(unit * before / amount, unit * after / amount)


def _rms(sums: Floats) -> BeforeAfter:
    before, after, count = sums.tolist()
    if not count:
        return NOTHING
    return BeforeAfter(math.sqrt(before / count), math.sqrt(after / count))
