"""Computes the multipliers of wheel separation and radii, and corrects them with a measured length.

A log with turn rates but without positions shows only the ratios of the multipliers. A distance
that was measured by tape then shows how large the wheels are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from msgspec import Struct

from acsard.calibration.fit import Base, Parameter
from acsard.calibration.heading import Rates
from acsard.calibration.log_table import Floats, NoCalibrationError
from acsard.core.config.settings import OdometryConfig
from acsard.core.values import Metres

# Indices into `Multipliers`.
SEPARATION, LEFT_RADIUS, RIGHT_RADIUS = range(3)


TOLERANCE = 1e-4  # difference between two multipliers that is too small to matter


class Deviations(Struct, frozen=True):
    """Relative standard deviations of the robot's geometry: track and wheel radii."""

    track: float  # of effective track / mean radius
    ratio: float  # of right / left wheel radius
    scale: float  # of the mean radius, to which all distances are proportional

    @classmethod
    def of(cls, odometry: OdometryConfig, base: Base) -> Deviations:
        """Return the standard deviations that `[odometry]` states for the configured geometry."""
        return cls(
            odometry.wheel_separation_multiplier_std / base.track,
            odometry.wheel_radius_ratio_std,
            odometry.distance_scale_std,
        )


class Multipliers(Struct, frozen=True):
    """The multipliers of wheel separation, left radius and right radius, with their covariance."""

    values: Floats  # the multipliers in the order of `SEPARATION`, `LEFT_RADIUS` and `RIGHT_RADIUS`
    covariance: Floats

    @property
    def std(self) -> Floats:
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def apart(self, base: Base) -> float:
        """Return how far these multipliers are from those of `base`, in standard deviations."""
        off = self.values - (base.track, base.left, base.right)
        return math.sqrt(off @ np.linalg.solve(self.covariance + TOLERANCE**2 * np.eye(3), off))

    def relative_deviations(self) -> Deviations:
        """Return the relative standard deviations of track, ratio of the radii and mean radius.

        The odometry treats the errors of these three as independent.
        """
        shares = self.covariance / np.outer(self.values, self.values)
        rows = np.array([[1.0, -0.5, -0.5], [0.0, -1.0, 1.0], [0.0, 0.5, 0.5]])
        return Deviations(*(math.sqrt(max(0.0, float(row @ shares @ row))) for row in rows))


def configured(base: Base) -> Multipliers:
    """Return the configured multipliers, with zeros for their unknown covariance."""
    return Multipliers(np.array([base.track, base.left, base.right]), np.zeros((3, 3)))


def multipliers(parameters: Floats, covariance: Floats, rate: Rates) -> Multipliers:
    """Return the multipliers that fit best at the mean turn rate of the log.

    The daemon uses one track for all turn rates. Skidding that differs from turn to turn is not in
    the variance, because it is noise of the odometry.
    """
    inverse, growth = parameters[Parameter.INVERSE_TRACK], parameters[Parameter.TRACK_GROWTH]
    slower = 1.0 - growth * rate.mean
    values = np.array(
        [1 / (inverse * slower), parameters[Parameter.LEFT], parameters[Parameter.RIGHT]]
    )
    jacobian = np.zeros((3, len(parameters)))
    jacobian[LEFT_RADIUS, Parameter.LEFT] = jacobian[RIGHT_RADIUS, Parameter.RIGHT] = 1.0
    jacobian[SEPARATION, Parameter.INVERSE_TRACK] = -values[SEPARATION] / inverse
    jacobian[SEPARATION, Parameter.TRACK_GROWTH] = values[SEPARATION] * rate.mean / slower
    return Multipliers(values, jacobian @ covariance @ jacobian.T)


RUN_LENGTH_STD_M = 0.01  # includes the choice of the point on the robot

# Distances by tape and by positions contradict each other if they differ by this fraction and by
# this number of standard deviations.
CONTRADICTS, CONTRADICTS_STD = 0.02, 5.0

UNKNOWN_SIZE_STD = 1.0  # of the logarithm of the wheels' size before any measurement

MIN_TAPE_M = 0.5  # between start and end of a run, to measure it by tape

MIN_STRAIGHTNESS = 0.8  # `Extent.straight` of a run, to measure it by tape


class Tape(Struct, frozen=True):
    """A straight-line distance from the start to the end of a run, measured by tape."""

    metres: float
    run: str = ""  # name of the run; "" means the straightest run of the log


class Extent(Struct, frozen=True):
    """Length of a run's path, and distance from its start to its end, by the wheels."""

    distance: Metres  # straight-line distance from start to end
    length: Metres  # length along the path

    @property
    def straight(self) -> float:
        """Ratio of `distance` to `length`, or 0 if the distance is at most `MIN_TAPE_M`."""
        return self.distance / self.length if self.distance > MIN_TAPE_M else 0.0


Follow = Callable[[Floats, int], Extent]  # the `Extent` of a run for given multipliers


def scaled(
    prior: Multipliers, tape: Tape, names: Sequence[str], follow: Follow, *, known: bool
) -> tuple[Multipliers, str]:
    """Correct the multipliers with a distance by tape, and return them with the name of its run.

    The correction is the update step of a Kalman filter on the logarithms of the multipliers.
    `known` says whether positions have already shown the size of the wheels. Raises
    `NoCalibrationError` if the run is missing, too short or not straight, or contradicts the
    positions.
    """
    if tape.run and tape.run not in names:
        raise NoCalibrationError(
            f'--distance: the log has no run "{tape.run}"; its runs are {", ".join(names[:10])}'
        )
    numbers = [names.index(tape.run)] if tape.run else range(len(names))
    extents = {number: follow(prior.values, number) for number in numbers}
    best = max(extents, key=lambda number: extents[number].straight)
    extent = extents[best]
    if extent.straight < MIN_STRAIGHTNESS:
        raise NoCalibrationError(
            f"--distance: run {names[best]} ends {extent.distance:.2f} m from its start, and its "
            f"path is {extent.length:.2f} m long, so it is too short or not straight enough: drive "
            "straight ahead for 2 m or more in a separate run, and measure from start to end"
        )
    # Of the logarithm of the distance by the logarithms of the multipliers.
    jacobian = np.zeros(3)
    for index in (SEPARATION, LEFT_RADIUS, RIGHT_RADIUS):
        longer = prior.values.copy()
        longer[index] *= 1.0 + 1e-4
        jacobian[index] = np.log(follow(longer, best).distance / extent.distance) / 1e-4
    logs = np.diag(1 / prior.values)
    covariance = logs @ prior.covariance @ logs
    if not known:
        covariance = covariance + UNKNOWN_SIZE_STD**2
    noise = (RUN_LENGTH_STD_M / tape.metres) ** 2
    variance = float(jacobian @ covariance @ jacobian + noise)
    longer_by = math.log(tape.metres / extent.distance)
    if known and abs(longer_by) > max(CONTRADICTS, CONTRADICTS_STD * math.sqrt(variance)):
        raise NoCalibrationError(
            f"--distance: according to the positions, run {names[best]} ends "
            f"{extent.distance:.2f} m from its start, but you measured {tape.metres:g} m: was this "
            "distance measured straight from the start to the end of this run, and are x and "
            "y in m?"
        )
    gain = covariance @ jacobian / variance
    values = prior.values * np.exp(gain * longer_by)
    rest = np.eye(3) - np.outer(gain, jacobian)
    covariance = rest @ covariance @ rest.T + np.outer(gain, gain) * noise
    back = np.diag(values)
    return Multipliers(values, back @ covariance @ back), names[best]
