"""Computes wheel radii and effective track from readings that a person took with a tape.

Each reading says where the robot ended relative to the last place where it was positioned: how far,
how much turned, or where in x and y. The fit is Gauss-Newton on all readings, as for positions
(`calibration/places.py` sums the path). A reading is off by the error of tape and eye and by
skidding on the way. If there are enough readings, their scatter shows how much the robot skidded.

A person ends the first turn on the spot with a key. The later turns use the track that the first
one showed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from msgspec import Struct

from acsard.calibration.doubts import RefusedError, in_range
from acsard.calibration.evidence import COUNT, LEFT, RATE, RIGHT, TURN, Base, condition
from acsard.calibration.fit import USUAL
from acsard.calibration.guided.legs import WIDEST, GuideError, Mean, Measure, What
from acsard.calibration.log_table import Floats
from acsard.calibration.paths import wheels
from acsard.calibration.places import Grid, grid, path
from acsard.calibration.runs import Run
from acsard.core.config.settings import DriveConfig

SKIDDING = 0.015
"""Heading error by skidding, rad for 1 m of rolling.

It grows with the square root of the distance.
"""

STRETCH = 0.002
"""Error of a distance by skidding, as a fraction of it."""

UNKNOWN = 1.0
"""Prior standard deviation of the mean radius, as a fraction."""

PRIOR_FREE = 4.0
"""Weight of the assumed noise (`SKIDDING`, `STRETCH`), as a number of readings."""

LEAST_FREE = 3.0
MOST_STEPS = 50
SMALL = 1e-9
WORST_CONDITION = 1e8
"""Largest condition number at which the readings determine the parameters."""

ACTIVE = [LEFT, RIGHT, TURN, RATE]

TELLS = 0.2
"""Largest standard deviation of a usable turn reading, as a fraction of the turn."""


class Reading(Struct, frozen=True):
    """A number that a person read off after some rides, and its standard deviation (rad or m)."""

    rides: tuple[Run, ...]
    what: What
    value: float
    deviation: float


class Predicted(Struct, frozen=True):
    """The predicted value of a reading, its slopes by parameter, and the variance by skidding."""

    value: float
    slopes: Floats
    variance: float


class Found(Struct, frozen=True):
    """Parameters with their covariance, and the residuals of each reading.

    `left` are the residuals of the fit to all readings; `without` are those of the fit without that
    reading.
    """

    parameters: Floats
    covariance: Floats
    left: Floats
    without: Floats


def joined(rides: Sequence[Run]) -> Grid:
    """Return several rides, one after the other, as a single grid."""
    grids = [grid(ride, wheels(ride)) for ride in rides]
    ends = np.cumsum([0.0] + [float(one.t[-1]) for one in grids])
    t = np.concatenate([grids[0].t[:1]] + [g.t[1:] + e for g, e in zip(grids, ends, strict=False)])
    columns = zip(*((g.left, g.right, g.fast) for g in grids), strict=True)
    return Grid(t, *(np.concatenate(column) for column in columns))


def predicted(steps: Grid, what: What, base: Base, parameters: Floats) -> Predicted:
    """Predict the value of a reading."""
    way = path(steps, base, parameters)
    rolled = base.radius * float(np.abs(steps.left).sum() + np.abs(steps.right).sum()) / 2
    slopes = np.zeros(COUNT)
    place, swing = complex(way.place[-1]), SKIDDING**2 * rolled
    if what in ("turned", "angle"):
        for index, bend in way.bends.items():
            slopes[index] = bend[-1]
        return Predicted(float(way.heading[-1]), slopes, swing)
    # The direction of the measurement: towards the end point, ahead, or to the left.
    along = {"ahead": 1.0 + 0j, "aside": 1j}.get(what, place / (abs(place) or 1.0))
    for index, values in way.slopes.items():
        slopes[index] = (np.conj(along) * values[-1]).real
    variance = (STRETCH * abs(place)) ** 2
    if what != "distance":
        # A turn on the way moves the end by the rest of the way. The mean square of that is a third
        # of the span squared.
        span = float(np.ptp(way.place.real) + np.ptp(way.place.imag))
        variance += swing * span**2 / 3
    return Predicted(float((np.conj(along) * place).real), slopes, variance)


def found(readings: Sequence[Reading], base: Base) -> Found:
    """Fit the parameters to the readings. Raises `RefusedError` if they contradict each other."""
    steps = [joined(reading.rides) for reading in readings]
    start = _begun(readings, steps, base)
    parameters, normal = _solved(readings, steps, base, start)
    in_range(np.array([1 / parameters[TURN], parameters[LEFT], parameters[RIGHT]]))
    left, weights = _left(readings, steps, base, parameters)
    # Combine the scatter of these readings with the assumed noise. If there are few readings, widen
    # it to that of Student's t.
    free = PRIOR_FREE + max(0.0, len(readings) - len(ACTIVE) + 1.0)
    scale = (PRIOR_FREE + float(weights @ left**2)) / free
    free = max(LEAST_FREE, free)
    covariance = np.zeros((COUNT, COUNT))
    inner = np.linalg.inv(normal[np.ix_(ACTIVE, ACTIVE)])
    covariance[np.ix_(ACTIVE, ACTIVE)] = inner * max(1.0, scale) * free / (free - 2)
    without = np.array([_without(n, readings, steps, base, parameters) for n in range(len(left))])
    return Found(parameters, covariance, left, without)


def _begun(readings: Sequence[Reading], steps: Sequence[Grid], base: Base) -> Floats:
    """Return starting parameters that agree with the first counted turn.

    From there on, angles that do not count whole turns are resolved correctly.
    """
    start = base.start()
    for reading, grid_ in zip(readings, steps, strict=True):
        if reading.what == "turned" and reading.deviation < TELLS * abs(reading.value):
            told = predicted(grid_, "turned", base, start).value
            if not 0.1 < told / reading.value < 10.0:
                raise RefusedError(
                    f"by the wheels the robot turned by {math.degrees(told):.0f} deg, by your "
                    f"measurement {math.degrees(reading.value):.0f}: start again, and let it turn "
                    "one full circle to the left"
                )
            start[TURN] *= reading.value / told
            break
    return start


def _solved(
    readings: Sequence[Reading], steps: Sequence[Grid], base: Base, start: Floats
) -> tuple[Floats, Floats]:
    """Return the parameters and the normal equations.

    Raises `RefusedError` if the readings do not determine the parameters.
    """
    parameters, begun = start.copy(), base.start()
    for _ in range(MOST_STEPS):
        normal, score = np.zeros((COUNT, COUNT)), np.zeros(COUNT)
        for reading, grid_ in zip(readings, steps, strict=True):
            told = predicted(grid_, reading.what, base, parameters)
            weight = 1 / (reading.deviation**2 + told.variance)
            normal += weight * np.outer(told.slopes, told.slopes)
            score += weight * told.slopes * _off(reading, told.value)
        normal[RATE, RATE] += USUAL[RATE] ** -2
        score[RATE] -= parameters[RATE] * USUAL[RATE] ** -2
        both = np.zeros(COUNT)
        both[[LEFT, RIGHT]] = 0.5
        normal += np.outer(both, both) / UNKNOWN**2
        score += both * float(both @ (begun - parameters)) / UNKNOWN**2
        inner = normal[np.ix_(ACTIVE, ACTIVE)]
        if condition(inner) > WORST_CONDITION:
            raise RefusedError(
                "the measurements cannot separate the wheels from the track: the robot hardly "
                "moved or hardly turned. Give it room, and start again"
            )
        step = np.linalg.solve(inner, score[ACTIVE])
        parameters[ACTIVE] += step * min(1.0, 0.3 / (float(np.abs(step).max()) or 1.0))
        if float(np.abs(step).max()) < SMALL:
            return parameters, normal
    raise RefusedError(
        "the measurements contradict each other: is each number in its unit, and of the end that "
        "the question names? Start again"
    )


def _off(reading: Reading, told: float) -> float:
    off = reading.value - told
    return math.remainder(off, 2 * math.pi) if reading.what == "angle" else off


def _left(
    readings: Sequence[Reading], steps: Sequence[Grid], base: Base, parameters: Floats
) -> tuple[Floats, Floats]:
    """Return the residual and the weight of each reading."""
    left, weights = [], []
    for reading, grid_ in zip(readings, steps, strict=True):
        told = predicted(grid_, reading.what, base, parameters)
        left.append(_off(reading, told.value))
        weights.append(1 / (reading.deviation**2 + told.variance))
    return np.array(left), np.array(weights)


def _without(
    number: int, readings: Sequence[Reading], steps: Sequence[Grid], base: Base, start: Floats
) -> float:
    """Return the residual of one reading by the fit without it, or NaN if that fit fails."""
    kept = [n for n in range(len(readings)) if n != number]
    try:
        parameters, _ = _solved([readings[n] for n in kept], [steps[n] for n in kept], base, start)
    except RefusedError:
        return math.nan
    told = predicted(steps[number], readings[number].what, base, parameters)
    return _off(readings[number], told.value)


READ_M = 0.002
"""Standard deviation of a distance of a few decimetres, and of placing the robot on a line, m."""

BELIEVABLE = 0.85, 3.0
"""Credible ratios of effective to geometric track. Outside them, a reading must be wrong."""

Answers = dict[tuple[str, str], float]
"""Numbers in m and rad by leg and name; the leg is "" if they were asked for before the first."""


def reading(measure: Measure, leg: str, rides: Mapping[str, Run], answers: Answers) -> Reading:
    """Return what a leg has measured. Raises `RefusedError` if the numbers are impossible."""
    driven = tuple(rides[name] for name in measure.over or (leg,))
    if isinstance(measure, Mean):
        numbers = [answers[leg, name] for name in measure.answers]
        value = measure.plus + sum(numbers) / len(numbers)
        return Reading(driven, measure.what, value, measure.deviation)
    apart = answers["", measure.apart]

    def angle(leg: str) -> float:
        return slant(answers[leg, measure.near], answers[leg, measure.far], apart)

    turned = angle(leg) - (angle(measure.since) if measure.since else 0.0)
    # Each of the two angles has two distances.
    return Reading(driven, measure.what, measure.plus + turned, 2 * READ_M / apart)


def effective(reading: Reading, drive: DriveConfig) -> float:
    """Return the approximate ratio of effective to geometric track by one reading of turns.

    Raises `GuideError` if it is not credible.
    """
    # Use the measured radius and separation without the configured multipliers.
    base = Base(drive.wheel_radius, drive.wheel_separation, 1.0, 1.0, 1.0)
    told = predicted(joined(reading.rides), "turned", base, base.start()).value
    track = told / reading.value
    least, most = BELIEVABLE
    if not least < track < most:
        raise GuideError(
            f"for one full circle the wheels report {math.degrees(told):.0f} deg: was it one full "
            "circle, and do drive.wheel_radius and drive.wheel_separation agree with a tape? Start "
            "again"
        )
    return min(WIDEST, max(1.0, track))


def slant(near: float, far: float, apart: float) -> float:
    """Return the angle in rad of a robot relative to a line.

    `near` and `far` are the distances from the line to two points of the robot that are `apart` m
    from each other. Raises `RefusedError` if that is impossible.
    """
    share = (far - near) / apart
    if abs(share) > 0.98:
        raise RefusedError(
            f"points {apart * 1000:.0f} mm apart cannot be {near * 1000:.0f} and "
            f"{far * 1000:.0f} mm from the line: measure again from the start"
        )
    return math.asin(share)
