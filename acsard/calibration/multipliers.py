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

SEPARATION, LEFT_RADIUS, RIGHT_RADIUS = range(3)
"""Indices into `Multipliers.values` and `Multipliers.covariance`."""


TOLERANCE = 1e-4
"""Difference between two multipliers that is too small to matter."""


class Deviations(Struct, frozen=True):
    """Relative standard deviations of the robot's geometry: track and wheel radii."""

    track: float
    """Relative standard deviation of the ratio of effective track to mean radius."""
    ratio: float
    """Relative standard deviation of the ratio of the right to the left wheel radius."""
    scale: float
    """Relative standard deviation of the mean radius, to which all distances are proportional."""

    @classmethod
    def of(cls, odometry: OdometryConfig, base: Base) -> Deviations:
        """Return the standard deviations that the settings of `[odometry]` state.

        `base` is the configured geometry, to which the settings belong.
        """
        sides = (
            odometry.left_wheel_radius_multiplier_std / base.left,
            odometry.right_wheel_radius_multiplier_std / base.right,
        )
        return cls(
            odometry.wheel_separation_multiplier_std / base.track,
            math.hypot(odometry.wheel_radius_ratio_std, *sides),
            math.hypot(odometry.distance_scale_std, math.hypot(*sides) / 2),
        )


class Multipliers(Struct, frozen=True):
    """The multipliers of wheel separation, left radius and right radius, with their covariance."""

    values: Floats
    """The multipliers in the order of `SEPARATION`, `LEFT_RADIUS` and `RIGHT_RADIUS`."""
    covariance: Floats

    @property
    def std(self) -> Floats:
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def apart(self, base: Base) -> float:
        """Return how far these multipliers are from those of `base`, in standard deviations.

        Chance alone hardly explains a large distance. A combination of multipliers that no sensor
        measures, such as their common scale, stays as configured. It adds nothing to the distance.
        """
        off = self.values - (base.track, base.left, base.right)
        return math.sqrt(off @ np.linalg.solve(self.covariance + TOLERANCE**2 * np.eye(3), off))

    def relative_deviations(self) -> Deviations:
        """Return the relative standard deviations of track, ratio of the radii and mean radius.

        The settings of `[odometry]` have the same form, because the odometry treats the errors of
        these three quantities as independent.
        """
        shares = self.covariance / np.outer(self.values, self.values)
        rows = np.array([[1.0, -0.5, -0.5], [0.0, -1.0, 1.0], [0.0, 0.5, 0.5]])
        return Deviations(*(math.sqrt(max(0.0, float(row @ shares @ row))) for row in rows))


def configured(base: Base) -> Multipliers:
    """Return the configured multipliers, with zeros for their unknown covariance."""
    return Multipliers(np.array([base.track, base.left, base.right]), np.zeros((3, 3)))


def multipliers(parameters: Floats, covariance: Floats, rate: Rates) -> Multipliers:
    """Return the multipliers that fit best at the turn rates of the log.

    The multiplier of the wheel separation describes the track at the mean turn rate of the log,
    because the daemon uses one track for all turn rates. The variance of this multiplier does not
    cover skidding that differs from turn to turn, because that is noise of the odometry.

    Args:
        parameters: the fitted parameters, shape (PARAMETER_COUNT,).
        covariance: the covariance of the parameters.
        rate: the turn rates of the log.
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


RUN_LENGTH_STD_M = 0.01
"""Standard deviation of a distance that a person measures by tape, m.

It includes the error of choosing the point on the robot to measure.
"""

CONTRADICTS, CONTRADICTS_STD = 0.02, 5.0
"""Limits for the difference between a distance by tape and the same distance by positions.

If the difference exceeds the fraction `CONTRADICTS` of the distance and also exceeds
`CONTRADICTS_STD` standard deviations, one of the two distances is wrong.
"""

UNKNOWN_SIZE_STD = 1.0
"""Standard deviation of the logarithm of the wheels' size if no measurement has shown the size."""

MIN_TAPE_M = 0.5
"""Shortest distance between start and end of a run, m, that a person may measure by tape."""

MIN_STRAIGHTNESS = 0.8
"""Smallest `Extent.straight` of a run whose distance a person may measure by tape."""


class Tape(Struct, frozen=True):
    """A straight-line distance from the start to the end of a run, measured by tape."""

    metres: float
    run: str = ""
    """Name of the run; "" means the straightest run of the log."""


class Extent(Struct, frozen=True):
    """Length of a run's path, and straight-line distance from its start to its end.

    Both are computed from the wheels.
    """

    distance: float
    """Straight-line distance from start to end, m."""
    length: float
    """Length along the path, m."""

    @property
    def straight(self) -> float:
        """Ratio of `distance` to `length`: 1 for a straight path, less for a curved path.

        The value is 0 if `distance` is not greater than `MIN_TAPE_M`.
        """
        return self.distance / self.length if self.distance > MIN_TAPE_M else 0.0


Follow = Callable[[Floats, int], Extent]
"""Function that returns the `Extent` of a run for given multipliers.

Its arguments are the multipliers, as in `Multipliers.values`, and the index of the run.
"""


def scaled(
    prior: Multipliers, tape: Tape, names: Sequence[str], follow: Follow, *, known: bool
) -> tuple[Multipliers, str]:
    """Correct the multipliers with a distance that was measured by tape.

    The correction is the update step of a Kalman filter on the logarithms of the multipliers.

    Args:
        prior: the multipliers to correct.
        tape: the distance that was measured.
        names: the names of the runs.
        follow: returns the `Extent` of a run for given multipliers.
        known: whether positions have already shown the size of the wheels.

    Returns:
        A pair: the corrected multipliers, and the name of the run whose distance was measured.

    Raises:
        NoCalibrationError: the log has no such run, the run is too short or not straight enough,
            or the distance contradicts the positions.
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
    # Derivatives of the logarithm of the distance with respect to the logarithms of the
    # multipliers.
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
