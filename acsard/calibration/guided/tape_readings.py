"""Computes a `Calibration` from tape readings: distances and turns since a known pose.

A Gauss-Newton fit compares the readings with the path that is computed from the wheels. They differ
because the person measures inaccurately, and because the robot skids. The scatter of enough
readings shows how much it skidded.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np
from msgspec import Struct

from acsard.calibration import heading
from acsard.calibration.fit import (
    PARAMETER_COUNT,
    PRIOR_STD,
    RADII,
    WHEEL_PARAMETERS,
    Base,
    Parameter,
    condition,
    student_factor,
)
from acsard.calibration.guided.drive_plan import (
    MAX_TRACK_RATIO,
    Distance,
    GuideError,
    Measure,
    Quantity,
)
from acsard.calibration.heading import Rates, rates
from acsard.calibration.improvement import (
    NOT_COMPARED,
    Improvement,
    per_amount,
    with_constant_track,
)
from acsard.calibration.log_table import Floats, NoCalibrationError
from acsard.calibration.multipliers import SEPARATION, configured, multipliers
from acsard.calibration.odometry_noise import settings
from acsard.calibration.plausibility import RATIO, TRACK, in_range, remarks, too_inaccurate
from acsard.calibration.positions import WheelSteps, path, wheel_steps
from acsard.calibration.runs import Run, blocks
from acsard.calibration.solve import Calibration, DriveTotals
from acsard.core.config.settings import DriveConfig

# After 1 m, rad; it grows with the square root of the rolled distance.
SKID_HEADING_STD = 0.015

SKID_LENGTH_STD = 0.002  # of a distance, relative

PRIOR_RADIUS_STD = 1.0  # of the mean wheel radius, relative

PRIOR_DEGREES_OF_FREEDOM = 4.0  # weight of the assumed noise against the scatter of the readings

MAX_STEPS = 50
CONVERGED = 1e-9  # largest change of a parameter in the last step of a fit

MAX_CONDITION = 1e8  # of normal equations from which the parameters can be computed

MAX_STARTING_STD = 0.2  # of the `turned` reading that gives the first estimate of the track


class Reading(Struct, frozen=True, dict=True):
    """A measurement by tape of the robot's motion over one or more recorded legs, rad or m."""

    rides: tuple[Run, ...]  # the recorded legs that the measurement covers, in order
    quantity: Quantity
    value: float
    deviation: float  # standard deviation of the measurement by tape, rad or m

    @cached_property
    def steps(self) -> WheelSteps:
        return joined(self.rides)

    def residual(self, prediction: float) -> float:
        """Return measured minus predicted value; for an `angle`, reduced to -pi to pi."""
        off = self.value - prediction
        return math.remainder(off, 2 * math.pi) if self.quantity == "angle" else off


class Predicted(Struct, frozen=True):
    """A prediction of a reading, computed from the angles by which the wheels rolled."""

    value: float
    derivatives: Floats  # of `value` by the parameters, shape (PARAMETER_COUNT,)
    variance: float  # of `value` due to skidding, rad2 or m2


class TapeFit(Struct, frozen=True):
    """The result of a fit to tape readings."""

    parameters: Floats
    covariance: Floats
    residuals: Floats  # measured minus predicted value of each reading, rad or m
    held_out: Floats  # the same with a fit to all other readings; NaN if that fit fails


def joined(rides: Sequence[Run]) -> WheelSteps:
    """Join several recorded legs to one, and return the angles by which the wheels rolled in it."""
    parts = [wheel_steps(ride) for ride in rides]
    ends = np.cumsum([0.0] + [float(part.t[-1]) for part in parts])
    later = [part.t[1:] + end for part, end in zip(parts, ends, strict=False)]
    t = np.concatenate([parts[0].t[:1], *later])
    columns = zip(
        *((part.left, part.right, part.signed_square_integral) for part in parts), strict=True
    )
    return WheelSteps(t, *(np.concatenate(column) for column in columns))


def predicted(steps: WheelSteps, quantity: Quantity, base: Base, parameters: Floats) -> Predicted:
    """Return a prediction of a reading from the angles by which the wheels rolled."""
    driven = path(steps, base, parameters)
    rolled = base.radius * float(np.abs(steps.left).sum() + np.abs(steps.right).sum()) / 2
    derivatives = np.zeros(PARAMETER_COUNT)
    if quantity != "distance":
        for index, values in driven.heading_derivatives.items():
            derivatives[index] = values[-1]
        return Predicted(float(driven.heading[-1]), derivatives, SKID_HEADING_STD**2 * rolled)
    place = complex(driven.place[-1])
    along = place / (abs(place) or 1.0)
    for index, by_parameter in driven.derivatives.items():
        derivatives[index] = (np.conj(along) * by_parameter[-1]).real
    return Predicted(abs(place), derivatives, (SKID_LENGTH_STD * abs(place)) ** 2)


def fit_readings(readings: Sequence[Reading], base: Base) -> TapeFit:
    """Fit the parameters to the readings.

    Raises `NoCalibrationError` if the readings contradict each other or do not determine the
    parameters.
    """
    parameters, normal = _solved(readings, base, _starting_parameters(readings, base))
    left, right, inverse = parameters[: Parameter.TRACK_GROWTH]
    in_range(np.array([1 / inverse, left, right]))
    compared = [(residual, weight) for _, residual, weight in _compared(readings, base, parameters)]
    residuals, weights = np.array(compared).T
    # The scatter of few readings is uncertain itself, so widen the deviation to Student's t.
    free = PRIOR_DEGREES_OF_FREEDOM + max(0.0, len(readings) - len(WHEEL_PARAMETERS) + 1.0)
    scale = (PRIOR_DEGREES_OF_FREEDOM + float(weights @ residuals**2)) / free
    covariance = np.zeros((PARAMETER_COUNT, PARAMETER_COUNT))
    inner = np.linalg.inv(normal[np.ix_(WHEEL_PARAMETERS, WHEEL_PARAMETERS)])
    covariance[np.ix_(WHEEL_PARAMETERS, WHEEL_PARAMETERS)] = (
        inner * max(1.0, scale) * student_factor(free)
    )
    held_out = np.array(
        [_held_out_residual(n, readings, base, parameters) for n in range(len(readings))]
    )
    return TapeFit(parameters, covariance, residuals, held_out)


def _starting_parameters(readings: Sequence[Reading], base: Base) -> Floats:
    start = base.start()
    for reading in readings:
        if reading.quantity == "turned" and reading.deviation < MAX_STARTING_STD * abs(
            reading.value
        ):
            by_wheels = predicted(reading.steps, "turned", base, start).value
            if not 0.1 < by_wheels / reading.value < 10.0:
                raise NoCalibrationError(
                    f"according to the wheels the robot turned {math.degrees(by_wheels):.0f} deg, "
                    f"but you measured {math.degrees(reading.value):.0f} deg: start again, and "
                    "let the robot turn one full circle to the left"
                )
            start[Parameter.INVERSE_TRACK] *= reading.value / by_wheels
            break
    return start


def _compared(
    readings: Sequence[Reading], base: Base, parameters: Floats
) -> Iterator[tuple[Predicted, float, float]]:
    for reading in readings:
        prediction = predicted(reading.steps, reading.quantity, base, parameters)
        weight = 1 / (reading.deviation**2 + prediction.variance)
        yield prediction, reading.residual(prediction.value), weight


def _solved(readings: Sequence[Reading], base: Base, start: Floats) -> tuple[Floats, Floats]:
    parameters, configured = start.copy(), base.start()
    for _ in range(MAX_STEPS):
        normal, score = np.zeros((PARAMETER_COUNT, PARAMETER_COUNT)), np.zeros(PARAMETER_COUNT)
        for prediction, residual, weight in _compared(readings, base, parameters):
            normal += weight * np.outer(prediction.derivatives, prediction.derivatives)
            score += weight * prediction.derivatives * residual
        growth, certainty = Parameter.TRACK_GROWTH, PRIOR_STD[Parameter.TRACK_GROWTH] ** -2
        normal[growth, growth] += certainty
        score[growth] -= parameters[growth] * certainty
        both = np.zeros(PARAMETER_COUNT)
        both[RADII] = 0.5
        normal += np.outer(both, both) / PRIOR_RADIUS_STD**2
        score += both * float(both @ (configured - parameters)) / PRIOR_RADIUS_STD**2
        inner = normal[np.ix_(WHEEL_PARAMETERS, WHEEL_PARAMETERS)]
        if condition(inner) > MAX_CONDITION:
            raise NoCalibrationError(
                "the measurements cannot separate errors of the wheel radii from errors of the "
                "track width, because the robot hardly moved or hardly turned: give the robot "
                "room, and start again"
            )
        step = np.linalg.solve(inner, score[WHEEL_PARAMETERS])
        parameters[WHEEL_PARAMETERS] += step * min(1.0, 0.3 / (float(np.abs(step).max()) or 1.0))
        if float(np.abs(step).max()) < CONVERGED:
            return parameters, normal
    raise NoCalibrationError(
        "the measurements contradict each other: is each number in the unit that was asked for, "
        "and was it measured at the end of the robot that the question names? Start again"
    )


def _held_out_residual(
    number: int, readings: Sequence[Reading], base: Base, start: Floats
) -> float:
    try:
        parameters, _ = _solved([*readings[:number], *readings[number + 1 :]], base, start)
    except NoCalibrationError:
        return math.nan
    ((_, residual, _),) = _compared([readings[number]], base, parameters)
    return residual


LINE_DISTANCE_STD_M = 0.002  # includes the choice of the point on the robot

TRACK_RATIO_RANGE = 0.85, 3.0  # range of credible ratios of effective track to wheel separation

# By the names of leg and question, m or rad; the leg is "" before the first leg.
Answers = dict[tuple[str, str], float]


def reading(measure: Measure, leg: str, rides: Mapping[str, Run], answers: Answers) -> Reading:
    """Return the reading that `measure` defines after the leg `leg`, from the person's answers.

    Raises `NoCalibrationError` if the answers are impossible.
    """
    if isinstance(measure, Distance):
        return Reading((rides[leg],), "distance", answers[leg, measure.answer], measure.deviation)
    driven = tuple(rides[name] for name in measure.over or (leg,))
    apart = answers["", measure.apart]

    def angle(leg: str) -> float:
        return slant(answers[leg, measure.near], answers[leg, measure.far], apart)

    turned = angle(leg) - (angle(measure.since) if measure.since else 0.0)
    # The turn is the difference of two angles, each from two distances: four errors.
    return Reading(driven, measure.quantity, measure.plus + turned, 2 * LINE_DISTANCE_STD_M / apart)


def track_ratio(reading: Reading, drive: DriveConfig) -> float:
    """Return effective track / wheel separation, limited to 1 to `MAX_TRACK_RATIO`.

    `reading` is one full turn. Raises `GuideError` if the ratio is not credible.
    """
    # Without the configured multipliers.
    base = Base(drive.wheel_radius, drive.wheel_separation, 1.0, 1.0, 1.0)
    by_wheels = predicted(reading.steps, "turned", base, base.start()).value
    track = by_wheels / reading.value
    least, most = TRACK_RATIO_RANGE
    if not least < track < most:
        raise GuideError(
            "the robot should have made one full turn, but according to the wheels it turned "
            f"{math.degrees(by_wheels):.0f} deg: check that it made exactly one turn, "
            "measure drive.wheel_radius and drive.wheel_separation with a tape measure, and run "
            "this command again"
        )
    return min(MAX_TRACK_RATIO, max(1.0, track))


def slant(near: float, far: float, apart: float) -> float:
    """Return the angle between the robot and a line, rad, positive after a turn to the left.

    A turn to the left moves the point at the distance `near` towards the line. All distances are in
    m. Raises `NoCalibrationError` if they are impossible.
    """
    sine = (far - near) / apart
    if abs(sine) > 0.98:
        raise NoCalibrationError(
            f"two points of the robot that are {apart * 1000:.0f} mm apart cannot be "
            f"{near * 1000:.0f} mm and {far * 1000:.0f} mm from the line: start the "
            "calibration again, and measure again"
        )
    return math.asin(sine)


# Relative standard deviations.
MAX_TAPE_STDS = {TRACK: 0.1, RATIO: 0.02}

# Above `TURNED` rad, a reading shows an error of turns; below `STRAIGHT`, of straight driving.
TURNED, STRAIGHT = np.pi, 0.5


def calibrated(readings: Sequence[Reading], drive: DriveConfig) -> Calibration:
    """Return the calibration from readings that a person made with a tape.

    Raises `NoCalibrationError` if the readings contradict each other or are too inaccurate.
    """
    base = Base.of(drive)
    rides = list({id(ride): ride for reading in readings for ride in reading.rides}.values())
    fit = fit_readings(readings, base)
    # There is no gyro, so the blocks only have to be short enough to show the turn rates.
    rows = heading.rows(None, rides, blocks(rides, 4.0))
    by_wheels = heading.turned(rows, base, fit.parameters)
    rate = rates(rows, by_wheels)
    result = multipliers(fit.parameters, fit.covariance, rate)
    inverse_track, std = fit.parameters[Parameter.INVERSE_TRACK], np.sqrt(np.diag(fit.covariance))
    chance = float(std[Parameter.INVERSE_TRACK] / abs(inverse_track))
    deviations = {TRACK: chance, RATIO: result.relative_deviations().ratio}
    for name, deviation in too_inaccurate(deviations, MAX_TAPE_STDS).items():
        raise NoCalibrationError(
            f"these readings determine {name} only to {deviation:.1%}, which is too inaccurate: "
            "the readings contradict each other, or the robot skids much. Start again on even "
            "ground, place the robot exactly, and measure to the millimetre"
        )
    drives = DriveTotals.of(rides, rows, by_wheels, base, result, rate)
    notes = remarks({}, 0.0, by_wheels, result.values, base, sized=True)
    return Calibration(
        reference="a tape", drives=drives, configured=configured(base), multipliers=result,
        scale="distance", growth=float(fit.parameters[Parameter.TRACK_GROWTH]),
        growth_std=float(std[Parameter.TRACK_GROWTH]),
        improvement=_improvement(readings, base, fit, rate),
        delays={}, gyro_bias=0.0, notes=tuple(notes),
        odometry=settings(
            result.relative_deviations(), float(result.values[SEPARATION]), (), scaled=True,
        ),
    )  # fmt: skip


def _improvement(readings: Sequence[Reading], base: Base, fit: TapeFit, rate: Rates) -> Improvement:
    sums = {name: np.zeros(3) for name in ("turn", "straight")}
    present = base.configured(fit.parameters)
    constant = with_constant_track(fit.parameters, rate)
    for number, reading in enumerate(readings):
        steps = reading.steps
        fitted = predicted(steps, reading.quantity, base, fit.parameters).value
        truth = fitted + fit.residuals[number]
        before = truth - predicted(steps, reading.quantity, base, present).value
        residual = fit.residuals[number] if np.isnan(fit.held_out[number]) else fit.held_out[number]
        # Unlike the fit, the robot uses one track for all turn rates.
        after = residual - (predicted(steps, reading.quantity, base, constant).value - fitted)
        if reading.quantity == "distance":
            continue
        turn = abs(predicted(steps, "turned", base, fit.parameters).value)
        if turn > TURNED:
            sums["turn"] += abs(before), abs(after), turn
        elif turn < STRAIGHT:
            rolled = abs(predicted(steps, "distance", base, fit.parameters).value)
            sums["straight"] += abs(before), abs(after), rolled
    return Improvement(
        per_amount(sums["turn"], 360.0), per_amount(sums["straight"], math.degrees(10.0)),
        NOT_COMPARED, NOT_COMPARED,
    )  # fmt: skip
