"""Computes the calibration from a log, or raises an error that says why it cannot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from acsard.calibration import fit as fitting
from acsard.calibration import heading, places
from acsard.calibration.doubts import RefusedError, UnlikeError, in_range, remarks
from acsard.calibration.evidence import DRIFT, LATE, LEFT, RATE, RIGHT, STRETCH, TURN, Base
from acsard.calibration.fit import (
    LEFT_RADIUS,
    RIGHT_RADIUS,
    SEPARATION,
    Fit,
    Multipliers,
    Rates,
    configured,
    fit,
    found,
    rates,
)  # fmt: skip
from acsard.calibration.gain import Gain, gain, seen_by_places
from acsard.calibration.heading import Headings, Rows
from acsard.calibration.log_table import Floats, noted
from acsard.calibration.paths import Wheels, wheels
from acsard.calibration.prepared import (
    DRIVE,
    Prepared,
    prepared,
    sure_enough,
    told_apart,
    turns_enough,
)
from acsard.calibration.runs import Log, Run
from acsard.calibration.tape_distance import Follow, Tape, Way, scaled
from acsard.core.config.settings import DriveConfig
from acsard.core.values import AcsardError

LENGTHS_S = {True: (4.0,), False: (8.0, 16.0, 32.0)}
"""Block lengths that are tried, s: with a heading sensor, and without.

Longer blocks are better if positions are coarse. More blocks are better if positions are fine.
"""


PERFECT = 1e-3
"""Fraction of the motion by which a true sensor differs from the wheels at least."""

PLENTY = 100
"""Number of blocks from which on other lengths are not tried, to save time."""


class Drives(Struct, frozen=True):
    """Totals of the drives."""

    runs: int
    seconds: float
    metres: float
    turns: float
    """Number of turns of 360 deg to both sides together, with the parameters found."""
    fastest: float
    """Rate of the fastest turns, rad/s."""

    @classmethod
    def of(
        cls, runs: Sequence[Run], rows: Rows, by_wheels: Floats, base: Base, found: Multipliers,
        rate: Rates,
    ) -> Drives:  # fmt: skip
        """Return the totals of these runs. `by_wheels` is the turn of each row, rad."""
        size = base.radius * float(found.values[[LEFT_RADIUS, RIGHT_RADIUS]].mean())
        return cls(
            len(runs), sum(float(run.t[-1]) for run in runs),
            size * float(np.abs(rows.left + rows.right).sum()) / 2,
            float(np.abs(by_wheels).sum()) / (2 * np.pi), rate.fastest,
        )  # fmt: skip


class Calibration(Struct, frozen=True):
    """The result. Each standard deviation has the unit of its quantity."""

    way: str
    """Sensors that the wheels were compared with."""
    drives: Drives
    now: Multipliers
    found: Multipliers
    scale: str
    """Sensors that measured the distance: "positions", "distance", both, or "" for none."""
    growth: float
    """Fraction by which the effective track grows with each rad/s of turn rate."""
    growth_std: float
    gain: Gain
    late: dict[str, float]
    """Delay of each sensor behind the wheels, s."""
    bias: float
    """Gyro bias, rad/s."""
    notes: tuple[str, ...]


def calibrate(log: Log, drive: DriveConfig, tape: Tape | None = None) -> Calibration:
    """Return the calibration of the robot that recorded this log.

    Raises `LogError` or `RefusedError`, to which the log's notes are added.
    """
    try:
        return _calibrated(log, drive, tape)
    except AcsardError as error:
        noted(error, log.notes)
        raise


def _calibrated(log: Log, drive: DriveConfig, tape: Tape | None) -> Calibration:
    base = Base.of(drive)
    angles = [wheels(run) for run in log.runs]
    headings = heading.of_gyro(log.runs, angles) or heading.of_yaw(log.runs, angles, base.gain)
    tries: list[tuple[float, int, Prepared, Fit]] = []
    unlike: UnlikeError | None = None
    for length in LENGTHS_S[headings is not None]:
        try:
            made = prepared(log.runs, angles, headings, base, length)
        except UnlikeError as error:
            unlike = unlike or error
            continue  # coarse positions may follow the wheels over longer blocks
        except RefusedError as error:
            raise unlike or error from None
        gyro = headings is not None and headings.source == "yaw_rate"
        drift = headings.unsure if headings is not None else 0.0
        fitted = fit(made.sources, made.start, places=bool(made.spots), gyro=gyro, drift=drift)
        unsure = float(np.trace(fitted.covariance()[: TURN + 1, : TURN + 1]))
        tries.append((unsure, len(tries), made, fitted))
        if not 3 * fitting.LEAST_BLOCKS <= len(made.parts) <= PLENTY:
            break  # half as many blocks would be too few, or these are plenty
    if unlike is not None and not tries:
        raise unlike
    _, _, made, fitted = min(tries)
    return _calibration(log, angles, headings, base, tape, made, fitted)


def _calibration(
    log: Log, angles: Sequence[Wheels], headings: Headings | None, base: Base, tape: Tape | None,
    made: Prepared, fitted: Fit,
) -> Calibration:  # fmt: skip
    """Convert the fit to settings and evaluate its improvement."""
    rows, spots, every = made.rows, made.spots, fitted.covariance()
    if not fitted.converged:
        raise RefusedError(f"the search for the parameters does not converge: {DRIVE}")
    told_apart(fitted.apart())
    by_wheels = heading.turned(rows, base, fitted.parameters)
    bias = headings.bias if headings is not None else 0.0
    drift, scale_of_gyro = float(fitted.parameters[DRIFT]), 1 + float(fitted.parameters[STRETCH])
    if headings is not None and headings.drifts:
        drift = heading.bias(rows, by_wheels * scale_of_gyro)
    bias += drift
    rows = replace(rows, turned=(rows.turned - drift * rows.seconds) / scale_of_gyro)
    rate, truth = rates(rows, by_wheels), rows.turned
    if headings is None:
        turns_enough(by_wheels)
        truth = seen_by_places(fitted, rows, base)
    result = found(fitted, rate)
    sure_enough(result, float(np.sqrt(every[TURN, TURN])) / abs(fitted.parameters[TURN]))
    better = gain(fitted, base, made.parts, rate, rows, truth, spots, made.grids)
    late = {headings.source: headings.late} if headings is not None else {}
    if spots:
        late["positions"] = float(fitted.parameters[LATE])
    scale, notes = ["positions"] if spots else [], list(log.notes)
    if tape is not None:
        follow = _follow(log.runs, angles, base, fitted, rate)
        names = [run.name for run in log.runs]
        result, name = scaled(result, tape, names, follow, known=bool(spots))
        scale.append("distance")
        notes.append(f"the distance of {tape.metres:g} m is used for run {name}")
    in_range(result.values)
    drives = Drives.of(log.runs, rows, by_wheels, base, result, rate)
    notes += _cuts(log.runs, angles)
    notes += _too_good(headings, made, fitted, base)
    notes += remarks(late, bias, by_wheels, result.values, base, sized=bool(scale))
    return Calibration(
        " and ".join(late), drives, configured(base), result, " and ".join(scale),
        float(fitted.parameters[RATE]), float(np.sqrt(every[RATE, RATE])), better, late, bias,
        tuple(notes),
    )  # fmt: skip


def _cuts(driven: Sequence[Run], angles: Sequence[Wheels]) -> Iterator[str]:
    """Yield a sentence for each kind of place where the log was cut."""
    if gone := sum(len(turned.gaps) for turned in angles):
        yield f"the wheel speeds have {gone} gaps: the tool uses no data across them"
    pairs = zip(driven, angles, strict=True)
    if jumps := sum(len(places.jumps(run, turned)) for run, turned in pairs):
        yield (
            f"the positions jump {jumps} times (outliers, or a source that corrected "
            "itself): the tool uses no data across the jumps"
        )


def _too_good(headings: Headings | None, made: Prepared, fitted: Fit, base: Base) -> Iterator[str]:
    """Yield a sentence for each source that agrees too well with the wheels for a true sensor."""
    rows = made.rows
    if headings is not None:
        off = rows.turned - heading.turned(rows, base, fitted.parameters)
        off -= np.median(off / rows.seconds) * rows.seconds
        if float(off @ off) < PERFECT**2 * float(rows.turned @ rows.turned):
            yield _own(headings.source)
    if made.spots:
        along = [places.path(one, base, fitted.parameters) for one in made.grids]
        reach = max(float(np.ptp(spot.place.real) + np.ptp(spot.place.imag)) for spot in made.spots)
        if places.spread(made.spots, along, fitted.parameters) < PERFECT * reach:
            yield _own("the positions")


def _own(what: str) -> str:
    return (
        f"no sensor agrees as well with the wheels as {what}: if these values were computed from "
        "the same wheels, like the odometry of a driver, the result describes the settings of that "
        "driver and not the robot; use a gyro, SLAM, GPS or motion capture"
    )


def _follow(
    driven: Sequence[Run], angles: Sequence[Wheels], base: Base, fitted: Fit, rate: Rates
) -> Follow:
    """Return a function that computes the way of a run for given multipliers.

    The track changes with the turn rate as the fit found.
    """

    def follow(values: Floats, number: int) -> Way:
        parameters = fitted.parameters.copy()
        parameters[[LEFT, RIGHT]] = values[[LEFT_RADIUS, RIGHT_RADIUS]]
        parameters[TURN] = 1 / (values[SEPARATION] * (1 - parameters[RATE] * rate.mean))
        place = places.path(places.grid(driven[number], angles[number]), base, parameters).place
        return Way(float(abs(place[-1])), float(np.abs(np.diff(place)).sum()))

    return follow
