"""Checks whether a log and its calibration are plausible, and whether the robot moved enough.

A log is refused if an error in it would spoil the calibration: a wrong sign, side, unit or time, or
sensors that contradict the wheels. Unusual facts that the calibration corrects or tolerates are
reported as remarks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from acsard.calibration import heading
from acsard.calibration.fit import MIN_BLOCKS, RADII, Base, Fit, Parameter, condition
from acsard.calibration.heading import Rows
from acsard.calibration.log_table import Floats, NoCalibrationError
from acsard.calibration.positions import StartingPoint
from acsard.calibration.runs import Block

MIN_TOTAL_TURN = 2 * np.pi  # rad; left turns and right turns are added

MIN_ROLL = 3.0  # rad, sum of the mean angles of both sides, and of half of their differences

MAX_CORRELATION = 0.98  # squared, of mean and difference; above it, all motion is the same curve

# Names of the two quantities that some logs do not determine accurately enough.
TRACK, RATIO = "the effective track", "the ratio of the right to the left wheel radius"

# Relative standard deviations.
MAX_LOG_STDS = {TRACK: 0.2, RATIO: 0.03}

MAX_CONDITION = 1e4  # of the normal equations at which radii and track can be separated

DRIVE_ADVICE = (
    "record a drive of 60 s: stand for 3 s, drive 2 m straight ahead and back, make three full "
    "turns to the left and three to the right, some slow and some fast, then drive curves both ways"
)

MAX_CONTRADICTION = 0.5  # fraction of a sensor's motion (squares) that wheels may not explain

WRONG_UNIT_RATIO = 8.0  # of a measured value to a configured one, above which a unit is wrong

# Skidding does not explain a smaller ratio of measured to predicted turn: speeds in rpm do.
MIN_TURN_RATIO = 0.2

# Of measured to configured radius: below, the unit of the positions is wrong; up to 1 /
# `WRONG_UNIT_RATIO`, that of the wheel speeds.
WRONG_POSITION_UNIT_RATIO = 2e-3

MAX_TURN_RATE = 12.0  # rad/s: two turns in a second; a larger value is probably in deg/s

MIN_TRACK_RATIO = 0.4  # of effective track to wheel separation; skidding only makes it larger

LEAST_FACTOR, MOST_FACTOR = 0.1, 10.0  # range of multipliers that the configuration accepts

NOTABLE_S, FAR_S = 0.005, 0.5

# Limits of the remarks.
LARGE_BIAS = 0.05  # of the gyro, rad/s
ONE_SIDED_RATIO = 0.1  # of turns to the rarer side
REPORTED_SIZE_RATIO = 1.25  # measured / configured wheel radius
REPORTED_RADIUS_RATIO = 1.1  # left / right wheel radius
LEAST_TRACK, MOST_TRACK = 0.85, 3.0  # effective track / wheel separation


def drives_enough(parts: Sequence[Block]) -> None:
    """Raise `NoCalibrationError` if the log has too few blocks (a few seconds of driving each)."""
    if len(parts) < MIN_BLOCKS:
        seconds = sum(part.end - part.begin for part in parts)
        raise NoCalibrationError(
            f"the wheels turn for only {seconds:.0f} s, which is too short: {DRIVE_ADVICE}"
        )


def turns_in_place(rows: Rows) -> bool:
    """Return whether the wheels roll ahead or back by less than `MIN_ROLL` in total.

    Such a log does not show the ratio of the wheel radii.
    """
    return float(np.abs(rows.right + rows.left).sum()) / 2 < MIN_ROLL


def rolls_enough(rows: Rows, *, spins: bool = False) -> None:
    """Raise `NoCalibrationError` if the log lacks driving ahead, turns, or a change between them.

    A robot that always drives the same curve does not separate them (`MAX_CORRELATION`). `spins`
    permits a log with only turns in place.
    """
    together, against = (rows.right + rows.left) / 2, (rows.right - rows.left) / 2
    in_place = spins and turns_in_place(rows)
    for rolled, what in ((together, "ahead or back"), (against, "in opposite directions")):
        angle = float(np.abs(rolled).sum())
        if angle < MIN_ROLL and not (in_place and rolled is together):
            raise NoCalibrationError(
                "in the whole log, the wheels of the two sides roll only "
                f"{angle / (2 * np.pi):.1f} revolutions {what}, which is too little to measure the "
                f"wheel radii and the effective track: {DRIVE_ADVICE}"
            )
    cross = float(together @ against) ** 2
    same_curve = cross > MAX_CORRELATION * float(together @ together) * float(against @ against)
    if same_curve and not in_place:
        raise NoCalibrationError(
            "the robot always drives the same curve, so the log cannot separate errors of the "
            f"wheel radii from errors of the track width: {DRIVE_ADVICE}"
        )


def turns_enough(turned: Floats) -> None:
    if (angle := float(np.abs(turned).sum())) < MIN_TOTAL_TURN:
        raise NoCalibrationError(
            f"the robot turned by {np.degrees(angle):.0f} deg in total, which is too little to "
            f"measure the effective track: {DRIVE_ADVICE}"
        )


def too_inaccurate(
    deviations: Mapping[str, float], accepted: Mapping[str, float]
) -> dict[str, float]:
    """Return the items of `deviations` that exceed the accepted values or are NaN."""
    return {name: std for name, std in deviations.items() if not std <= accepted[name]}


def inaccuracy(deviations: Mapping[str, float], accepted: Mapping[str, float]) -> str:
    """Return the text of the error for a log that determines `TRACK` or `RATIO` too inaccurately.

    A deviation is inf or NaN if the log does not determine the quantity at all.
    """
    reasons = [
        f"the standard deviation of {name} is {deviation:.1%}, but at most "
        f"{100 * accepted[name]:g}% is accepted"
        if np.isfinite(deviation)
        else f"{name} cannot be determined"
        for name, deviation in deviations.items()
    ]
    return f"this log is too inaccurate: {', and '.join(reasons)}: {DRIVE_ADVICE}"


def separates_track(fitted: Fit) -> bool:
    """Return whether the log distinguishes errors of the wheel radii from errors of the track."""
    return condition(fitted.marginal()) <= MAX_CONDITION


def heading_follows(source: str, rows: Rows, base: Base, sides: Floats) -> None:
    """Raise `NoCalibrationError` if the wheels and the heading sensor show very different turns."""
    spread = float(rows.turned @ rows.turned)
    off = rows.turned - heading.by_sides(rows, base, sides)
    if not spread or float(off @ off) > MAX_CONTRADICTION * spread:
        raise NoCalibrationError(
            f"{source} does not follow the wheels. Check that it is the yaw rate (not roll or "
            "pitch), that it and the wheel speeds come from the same run, that their clocks differ "
            "by less than 2 s, that the wheels touched the ground, and that the columns of the "
            "wheels are speeds, not angles"
        )


def positions_follow(starting_point: StartingPoint) -> None:
    """Raise `NoCalibrationError` if the positions do not follow the path of the wheels."""
    if starting_point.unexplained > MAX_CONTRADICTION:
        raise NoCalibrationError(
            "the positions do not match the motion of the wheels: check that x is ahead and y to "
            "the left in m (not latitude and longitude), that wheels and positions come from the "
            "same drive, and that their clocks differ by less than 1 s"
        )


def turns_the_right_way(
    source: str, sides: Floats | None, starting_point: StartingPoint | None
) -> None:
    """Raise `NoCalibrationError`, which names the wrong sign, if turns have opposite directions.

    `source` is "" and `sides` is None without a heading sensor; `starting_point` is None without
    positions.
    """
    by_places = by_heading = ""
    if starting_point is not None:
        turn = starting_point.parameters[Parameter.INVERSE_TRACK]
        by_places = by_heading = _wrong_sign(starting_point.parameters[RADII] * turn)
    if sides is not None:
        by_heading = _wrong_sign(sides)
    for side in ("left", "right"):
        if side in (by_heading, by_places):
            raise NoCalibrationError(
                f"the {side} wheels turn backwards when the robot goes ahead: their speeds have "
                "the wrong sign; the speeds of both sides must be positive when the robot drives "
                "ahead"
            )
    if sides is not None and starting_point is not None and by_heading != by_places:
        other = "x and y are swapped, or y is positive to the right"
        sign = f"{source} has the wrong sign (it must be positive to the left)"
        raise NoCalibrationError(
            f"wheels and positions agree on the direction of turns, but {source} does not: {sign}"
            if by_heading
            else f"wheels and {source} agree on the direction of turns, but the positions do not: "
            f"{other}"
        )
    if by_heading:
        sensor = source or "the positions"
        # If two sensors agree, the wheels are wrong. A single one may be wrong itself.
        or_sensor = (
            ""
            if starting_point is not None and sides is not None
            else ", or x and y are swapped, or y is positive to the right"
            if sides is None
            else ", or the sensor is positive to the right (it must be positive to the left)"
        )
        raise NoCalibrationError(
            f"{sensor} and the wheels show turns in opposite directions: the columns of left and "
            "right are swapped, or the wheel speeds of both sides are negative when the robot "
            f"drives ahead{or_sensor}"
        )


def _wrong_sign(sides: Floats) -> str:
    left, right = (sides > 0.0).tolist()
    if left:
        return "" if right else "right"
    return "left" if right else "turn"


def turns_like_the_wheels(source: str, rows: Rows, base: Base) -> None:
    """Raise `NoCalibrationError` if the heading sensor shows far smaller turns than the wheels."""
    angle = float(np.abs(rows.turned).sum())
    by_wheels = float(np.abs(heading.by_sides(rows, base, np.ones(2))).sum())
    if angle < MIN_TURN_RATIO * by_wheels:
        raise NoCalibrationError(
            f"{source} shows turns of {np.degrees(angle):.0f} deg in total, but the wheels would "
            f"turn the robot by up to {np.degrees(by_wheels):.0f} deg: is {source} the rate about "
            "the upright axis? If the IMU lies on its side, fill the column with the rate about "
            "the axis that points up, positive to the left. Are the wheel speeds in rad/s, not "
            "counts, deg/s or rpm?"
        )


def turn_rates(source: str, rows: Rows) -> None:
    """Raise `NoCalibrationError` if the heading sensor seems to report its turns in degrees.

    The wheel speeds are not used, because they may be in degrees as well.
    """
    rate = float(np.percentile(np.abs(rows.turned) / rows.seconds, 90))
    if rate > MAX_TURN_RATE:
        raise NoCalibrationError(
            f"{source} seems to be in degrees (multiply by pi / 180), because as radians the robot "
            f"would turn at {rate:.0f} rad/s; also check that the wheel speeds are in rad/s, not "
            "deg/s, rpm or mm/s"
        )


def turn_units(source: str, turn: float, turn_without_multipliers: float, base: Base) -> None:
    """Raise `NoCalibrationError` if the turns of sensor and wheels show that a unit is wrong.

    `turn` is measured / predicted turn with the configured multipliers, `turn_without_multipliers`
    with multipliers of 1. `source` is "" if positions show the turns.
    """
    if MIN_TURN_RATIO < turn < WRONG_UNIT_RATIO and turn_without_multipliers < 1 / MIN_TRACK_RATIO:
        return
    degrees = f"{source} is in degrees (multiply by pi / 180), or " * bool(source)
    may = (
        f"{degrees}the wheel speeds are in m/s (divide by the wheel radius) or turns/s (multiply "
        "by 2 pi)"
        if turn > 1
        else "the wheel speeds are in deg/s, rpm or counts, or are angles (they must be in rad/s)"
    )
    raise NoCalibrationError(
        f"the robot turns {turn:.3g} times as far as its wheels report: {may}, or "
        f"drive.wheel_radius = {base.radius:g} and drive.wheel_separation = {base.separation:g} "
        "belong to another robot (give the right file with --config)"
    )


def distance_units(size: float, base: Base) -> None:
    """Raise `NoCalibrationError` if measured / configured wheel radius shows a wrong unit."""
    if 1 / WRONG_UNIT_RATIO < size < WRONG_UNIT_RATIO:
        return
    may = (
        "the wheel speeds are in m/s (divide by the wheel radius), or the positions are in mm or cm"
        if size > 1
        else "the positions are latitude and longitude, or in km (they must be x ahead and y to "
        "the left, in m)"
        if size < WRONG_POSITION_UNIT_RATIO
        else "the wheel speeds are in deg/s, rpm or counts, or are angles (they must be in rad/s)"
    )
    raise NoCalibrationError(
        f"the robot drives {size:.3g} times as far as its wheels report: {may}, or "
        f"drive.wheel_radius = {base.radius:g} belongs to another robot (give the right file "
        "with --config)"
    )


def in_range(values: Floats) -> None:
    """Raise `NoCalibrationError` if the configuration does not accept the multipliers `values`."""
    if np.all((values >= LEAST_FACTOR) & (values <= MOST_FACTOR)):
        return
    text = ", ".join(f"{value:.3g}" for value in values)
    raise NoCalibrationError(
        f"the multipliers are {text} (wheel separation, left radius, right radius), but must be "
        f"from {LEAST_FACTOR:g} to {MOST_FACTOR:g}: first measure wheel radius and wheel "
        "separation by tape, and write drive.wheel_radius and drive.wheel_separation into the "
        "configuration"
    )


def remarks(
    delays: dict[str, float],
    bias: float,
    turned: Floats,
    values: Floats,
    base: Base,
    *,
    sized: bool,
) -> Iterator[str]:
    """Yield a sentence for each unusual fact that the calibration corrects or tolerates."""
    for source, seconds in delays.items():
        if abs(seconds) >= NOTABLE_S:
            word = "later" if seconds > 0 else "earlier"
            far = "; synchronize the clocks" if abs(seconds) > FAR_S else ""
            yield (
                f"the times of {source} are {abs(seconds) * 1000:.0f} ms {word} than those of the "
                f"wheels; the calibration has corrected this{far}"
            )
    if abs(bias) > LARGE_BIAS:
        yield (
            f"the gyro shows {bias:.3f} rad/s while the robot stands: the calibration has "
            "corrected this large value"
        )
    left, right = float(turned[turned > 0].sum()), float(-turned[turned < 0].sum())
    if min(left, right) < ONE_SIDED_RATIO * max(left, right):
        yield (
            "nearly all turns are to one side, so the calibration does not show a difference "
            "between left and right turns: drive turns to both sides"
        )
    size = float(values[1:].mean())
    if sized and not 1 / REPORTED_SIZE_RATIO < size < REPORTED_SIZE_RATIO:
        yield (
            f"the wheels are {size:.3g} times as large as drive.wheel_radius = {base.radius:g}: "
            "measure the radius, and check that wheel speeds are in rad/s and x, y in m"
        )
    ratio = float(values[2] / values[1])
    if not 1 / REPORTED_RADIUS_RATIO < ratio < REPORTED_RADIUS_RATIO:
        yield (
            f"the right wheels are {ratio:.3g} times as large as the left ones, which is unusual: "
            "compare their sizes, and check that the speeds of both sides have the same unit and "
            "that no encoder misses counts"
        )
    track = float(values[0])
    if not LEAST_TRACK < track < MOST_TRACK:
        yield (
            f"an effective track of {track:.3g} times drive.wheel_separation = "
            f"{base.separation:g} is unusual (1 to 2.5 is usual): measure the wheel "
            "separation, and check all units"
        )
