"""Computes the calibration from a log, or says why the log gives none."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from acsard.calibration import heading, plausibility, positions
from acsard.calibration.fit import PARAMETER_COUNT, RADII, Base, Fit, Held, Parameter, Source, fit
from acsard.calibration.heading import Headings, Rates, Rows, rates
from acsard.calibration.improvement import (
    UNMEASURED,
    Improvement,
    folds,
    improvement,
    no_better,
    positions_of,
)
from acsard.calibration.log_table import Floats, NoCalibrationError, attach_notes
from acsard.calibration.multipliers import (
    LEFT_RADIUS,
    RIGHT_RADIUS,
    SEPARATION,
    Deviations,
    Extent,
    Follow,
    Multipliers,
    Tape,
    configured,
    multipliers,
    scaled,
)  # fmt: skip
from acsard.calibration.odometry_noise import LogNoise, Reference, noise, settings
from acsard.calibration.plausibility import DRIVE_ADVICE, MAX_LOG_STDS, RATIO, TRACK
from acsard.calibration.positions import Segment, WheelSteps, search
from acsard.calibration.runs import Block, Log, Run, blocks
from acsard.calibration.wheel_response import response
from acsard.core.config.settings import DriveConfig, FeedbackConfig, OdometryConfig
from acsard.core.values import AcsardError, RadPerS

# Short blocks suit accurate positions, long ones coarse positions or wheels whose errors hide small
# turns. The length that improves the odometry most is used.
BLOCK_LENGTHS_S = (4.0, 8.0, 16.0, 32.0, 64.0)

# With six blocks, the deviation of the ratio of the radii was up to three times too small.
MIN_BLOCKS = 8

# As a fraction of the motion: with less, the sensor was computed from the wheels. Motion capture
# differs by up to 1e-3.
MIN_DIFFERENCE = 1e-4


class DriveTotals(Struct, frozen=True):
    """Totals of the drives in a log."""

    runs: int
    seconds: float
    metres: float
    turns: float  # to the left and to the right, of 360 deg
    fastest: RadPerS  # below which the robot turned 95 % of its total turned angle

    @classmethod
    def of(
        cls, runs: Sequence[Run], rows: Rows, by_wheels: Floats, base: Base, result: Multipliers,
        rate: Rates,
    ) -> DriveTotals:  # fmt: skip
        """Return the totals of the runs. `by_wheels` has the turn in each interval, rad."""
        size = base.radius * float(result.values[[LEFT_RADIUS, RIGHT_RADIUS]].mean())
        return cls(
            len(runs), sum(float(run.t[-1]) for run in runs),
            size * float(np.abs(rows.left + rows.right).sum()) / 2,
            float(np.abs(by_wheels).sum()) / (2 * np.pi), rate.fastest,
        )  # fmt: skip


class Calibration(Struct, frozen=True):
    """The result of a calibration. Each standard deviation has the unit of its quantity."""

    reference: str  # what the wheels were compared with: "yaw_rate and positions", "a tape"
    drives: DriveTotals
    configured: Multipliers
    multipliers: Multipliers
    scale: str  # shown by "positions", "distance", "positions and distance" or ""
    growth: float  # fraction by which the effective track grows with each rad/s of turn rate
    growth_std: float
    improvement: Improvement
    delays: dict[str, float]  # of recorded times after those of the wheels, s, by sensor
    gyro_bias: RadPerS  # 0 without a gyro
    notes: tuple[str, ...]
    odometry: dict[str, float]  # new values by setting; noise only if `LogNoise.better`
    stays_configured: tuple[str, ...] = ()  # `plausibility.TRACK`, `plausibility.RATIO`
    # New values by setting; empty if the present ones cause no false wheel fault or none is better.
    feedback: dict[str, float] = {}
    noise: LogNoise | None = None  # that this log shows


def calibrate(
    log: Log, drive: DriveConfig, tape: Tape | None = None,
    odometry: OdometryConfig | None = None, feedback: FeedbackConfig | None = None,
) -> Calibration:  # fmt: skip
    """Return the calibration of the robot that recorded this log.

    Raises `LogError` or `NoCalibrationError`, with the notes of the log attached.
    """
    follows = response(log.runs, drive, feedback or FeedbackConfig())
    if follows is not None:
        log = replace(log, notes=(*follows.sentences(), *log.notes))
    try:
        calibration = _calibrated(log, drive, tape, odometry or OdometryConfig())
        return replace(calibration, feedback={} if follows is None else follows.settings())
    except AcsardError as error:
        attach_notes(error, log.notes)
        raise


class Prepared(Struct, frozen=True):
    """A log that was divided into blocks of one length, and all other inputs of the fit."""

    runs: Sequence[Run]
    headings: Headings | None  # None if the log has no heading sensor
    base: Base
    parts: list[Block]  # of all runs
    rows: Rows  # a gyro is corrected for its bias, unless this is unknown
    segments: list[Segment]  # measured positions; empty if the log has no positions
    steps: list[WheelSteps]  # rolling in each run; empty if the log has no positions
    sources: list[Source]  # one for each sensor
    start: Floats  # parameters from which the fit starts, shape (PARAMETER_COUNT,)


def prepared(
    driven: Sequence[Run], headings: Headings | None, base: Base, length: float
) -> Prepared:
    """Divide the runs into blocks, check the log, and return the inputs of the fit.

    The blocks are about `length` s long. Raises `NoCalibrationError` if a check fails.
    """
    parts = blocks(driven, length)
    plausibility.drives_enough(parts)
    count, start = len(parts), base.start()
    every = rows = heading.rows(headings, driven, parts)
    if headings is not None and headings.bias_unknown and len(every.turned):
        rows = heading.without_constant_rate(every)
    if headings is not None and not len(rows.turned):
        raise NoCalibrationError(
            f"{headings.source} has no samples while the wheels turn: record it at the same time "
            "as the wheels, with times from the same clock"
        )
    segments = positions.segments(driven, parts)
    plausibility.rolls_enough(rows, spins=headings is not None and not segments)
    steps = [positions.wheel_steps(run) for run in driven] if segments else []
    sources: list[Source] = []
    sides = by_positions = None
    if headings is not None:
        plausibility.turns_like_the_wheels(headings.source, rows, base)
        plausibility.turns_enough(rows.turned)
        sides = heading.side_factors(rows, base, in_place=plausibility.turns_in_place(rows))
        plausibility.heading_follows(headings.source, rows, base, sides)
        sources.append(lambda p: heading.evidence(rows, base, p, count))
    if segments:
        by_positions = search(segments, driven, base, sides)
        plausibility.positions_follow(by_positions)
        sources.append(
            lambda p: positions.evidence(
                segments, [positions.path(g, base, p) for g in steps], count
            )
        )
        start = by_positions.parameters.copy()
    if not sources:
        raise NoCalibrationError(
            "there are no positions or turn rates while the robot drives: record one of them at "
            "the same time as the wheels, with times from the same clock"
        )
    plausibility.turns_the_right_way(headings.source if headings else "", sides, by_positions)
    if sides is not None:
        mean, size = float(sides.mean()), float(start[RADII].mean())
        start[RADII] = size * sides / mean
        start[Parameter.INVERSE_TRACK] = mean / size
    if headings is not None:
        plausibility.turn_rates(headings.source, rows)
    _check_units(headings, start, base, by_positions is not None)
    return Prepared(driven, headings, base, parts, every, segments, steps, sources, start)


def _check_units(headings: Headings | None, start: Floats, base: Base, sized: bool) -> None:
    size, configured = float(start[RADII].mean()), base.start()
    if sized:
        plausibility.distance_units(size, base)
    turn_without_multipliers = size * float(start[Parameter.INVERSE_TRACK])
    turn = turn_without_multipliers / float(
        configured[RADII].mean() * configured[Parameter.INVERSE_TRACK]
    )
    plausibility.turn_units(
        headings.source if headings else "", turn, turn_without_multipliers, base
    )


class Candidate(Struct, frozen=True):
    """A fit to blocks of one length, and the improvement of the odometry that it brings."""

    made: Prepared
    fitted: Fit
    covariance: Floats  # of the parameters, shape (PARAMETER_COUNT, PARAMETER_COUNT)
    rows: Rows  # with the gyro corrected for its bias and scale
    rate: Rates
    gyro_bias: RadPerS  # 0 without a gyro
    result: Multipliers
    improvement: Improvement
    stays_configured: dict[str, float]  # relative deviation of the quantity; inf if unknown


def _calibrated(
    log: Log, drive: DriveConfig, tape: Tape | None, odometry: OdometryConfig
) -> Calibration:
    base = Base.of(drive)
    headings = heading.of_gyro(log.runs) or heading.of_yaw(log.runs, base.radius_per_separation)
    candidates: list[Candidate] = []
    refusals: list[NoCalibrationError] = []
    places = any(len(run.place) for run in log.runs)
    for length in BLOCK_LENGTHS_S[headings is None and places : None if places else 1]:
        try:
            made = prepared(log.runs, headings, base, length)
            if candidates and len(made.parts) < MIN_BLOCKS:
                break
            candidates += _candidates(made)
        except NoCalibrationError as error:
            refusals.append(error)  # coarse positions may still follow the wheels in longer blocks
    if not candidates:
        raise refusals[0]
    best = max(candidates, key=lambda candidate: candidate.improvement.log_improvement)
    worse = "" if best.improvement.sure else no_better(best.improvement)
    if worse:
        best = replace(
            best, result=configured(base), stays_configured={TRACK: np.inf, RATIO: np.inf},
            improvement=UNMEASURED,
        )  # fmt: skip
    known = _used_deviations(best, odometry)
    log_noise = _noise(best, known, odometry, present=bool(worse))
    # With a tape, the calibration gives the size of the wheels even if the log improves nothing.
    if worse and tape is None and (log_noise is None or not log_noise.better):
        raise NoCalibrationError(worse)
    return _calibration(log, tape, best, known, log_noise)


def _used_deviations(best: Candidate, odometry: OdometryConfig) -> Deviations:
    base, new = best.made.base, best.result.relative_deviations()
    now = Deviations.of(odometry, base)
    return Deviations(
        now.track if TRACK in best.stays_configured else new.track,
        now.ratio if RATIO in best.stays_configured else new.ratio,
        new.scale if best.made.segments and len(best.stays_configured) < 2 else now.scale,
    )


def _noise(
    best: Candidate, known: Deviations, odometry: OdometryConfig, *, present: bool
) -> LogNoise | None:
    made, fitted = best.made, best.fitted
    test_folds = folds(fitted, made.parts, made.runs, best.rate)
    if present:
        start = made.base.configured(fitted.parameters)
        test_folds = [replace(fold, parameters=start) for fold in test_folds]
    parameters = fitted.parameters.copy()
    if made.headings is not None:
        parameters[Parameter.BIAS_ERROR] = best.gyro_bias - made.headings.bias
    steps = made.steps or [positions.wheel_steps(run) for run in made.runs]
    sensors = Reference(made.runs, made.headings, bool(made.segments), steps, made.base, parameters)
    return noise(test_folds, sensors, known, odometry)


def _candidates(made: Prepared) -> list[Candidate]:
    candidates: list[Candidate] = []
    deviations: dict[str, float] = {}
    refused: dict[str, float] = {}
    headings = made.headings
    gyro = headings is not None and headings.source == "yaw_rate"
    bias_std = headings.bias_std if headings is not None else 0.0
    for fixed, constraints in _constraints(made.base).items():
        if candidates and not candidates[0].stays_configured:
            break
        fitted = fit(
            made.sources, made.start, places=bool(made.segments), gyro=gyro, bias_std=bias_std,
            held=constraints,
        )  # fmt: skip
        if fitted.converged:
            candidate = _candidate(made, fitted)
            track = float(
                np.sqrt(candidate.covariance[Parameter.INVERSE_TRACK, Parameter.INVERSE_TRACK])
            )
            track /= abs(float(fitted.parameters[Parameter.INVERSE_TRACK]))
            found = {TRACK: track, RATIO: candidate.result.relative_deviations().ratio}
            too_wide = plausibility.too_inaccurate(found, MAX_LOG_STDS)
            if not fixed:
                deviations = found
                if not plausibility.separates_track(fitted):
                    too_wide[RATIO] = deviations[RATIO] = np.inf
            if not too_wide:
                deviation_by_name = {fixed: deviations.get(fixed, np.inf)} if fixed else {}
                candidates.append(replace(candidate, stays_configured=deviation_by_name))
            # The fit of both quantities comes first, so its deviations are reported.
            refused = too_wide | refused
    if not candidates:
        raise NoCalibrationError(
            plausibility.inaccuracy(refused, MAX_LOG_STDS)
            if refused
            else f"the search for the parameters does not converge: {DRIVE_ADVICE}"
        )
    return candidates


def _constraints(base: Base) -> dict[str, list[Held]]:
    ratio, track, growth = np.zeros((3, PARAMETER_COUNT))
    ratio[RADII] = base.right, -base.left
    track[Parameter.INVERSE_TRACK] = growth[Parameter.TRACK_GROWTH] = 1.0
    return {"": [], RATIO: [(ratio, 0.0)], TRACK: [(track, 1 / base.track), (growth, 0.0)]}


def _candidate(made: Prepared, fitted: Fit) -> Candidate:
    headings, base = made.headings, made.base
    rows, by_wheels = made.rows, heading.turned(made.rows, base, fitted.parameters)
    gyro_scale = 1 + float(fitted.parameters[Parameter.SCALE_ERROR])
    bias_error = float(fitted.parameters[Parameter.BIAS_ERROR])
    if headings is None:
        plausibility.turns_enough(by_wheels)
    elif headings.bias_unknown:
        bias_error = heading.bias(rows, by_wheels * gyro_scale)
    gyro_bias = (headings.bias if headings is not None else 0.0) + bias_error
    rows = replace(rows, turned=(rows.turned - bias_error * rows.seconds) / gyro_scale)
    rate = rates(rows, by_wheels)
    test_folds = folds(fitted, made.parts, made.runs, rate)
    places = [positions_of(fold.drive, made.runs) if made.segments else [] for fold in test_folds]
    better = improvement(
        test_folds, base.configured(fitted.parameters), base, rows, places, made.steps
    )
    covariance = fitted.covariance([part.run for part in made.parts])
    result = multipliers(fitted.parameters, covariance, rate)
    better = replace(better, apart=result.apart(base))
    return Candidate(made, fitted, covariance, rows, rate, gyro_bias, result, better, {})


def _calibration(
    log: Log,
    tape: Tape | None,
    best: Candidate,
    known: Deviations,
    log_noise: LogNoise | None,
) -> Calibration:
    made, fitted, rows, rate = best.made, best.fitted, best.rows, best.rate
    headings, base = made.headings, made.base
    by_wheels, result = heading.turned(rows, base, fitted.parameters), best.result
    delays = {headings.source: headings.delay} if headings is not None else {}
    if made.segments:
        delays["positions"] = float(fitted.parameters[Parameter.DELAY])
    # Without an improvement, `stays_configured` has both quantities, and nothing shows the scale.
    measured = bool(made.segments) and len(best.stays_configured) < 2
    scale, notes = ["positions"] if measured else [], list(log.notes)
    if tape is not None:
        follow = _follow(made, fitted, rate)
        names = [run.name for run in log.runs]
        result, name = scaled(result, tape, names, follow, known=measured)
        scale.append("distance")
        notes.append(f"the distance of {tape.metres:g} m by tape was compared with run {name}")
    plausibility.in_range(result.values)
    if tape is not None:
        known = replace(known, scale=result.relative_deviations().scale)
    totals = DriveTotals.of(log.runs, rows, by_wheels, base, result, rate)
    notes += [_stays(name, deviation) for name, deviation in best.stays_configured.items()]
    notes += _of_noise(log_noise)
    notes += _cuts(log.runs)
    notes += _too_good(made, fitted, log)
    notes += plausibility.remarks(
        delays, best.gyro_bias, by_wheels, result.values, base, sized=bool(scale)
    )
    return Calibration(
        reference=" and ".join(delays), drives=totals, configured=configured(base),
        multipliers=result, scale=" and ".join(scale),
        growth=float(fitted.parameters[Parameter.TRACK_GROWTH]),
        growth_std=float(np.sqrt(best.covariance[Parameter.TRACK_GROWTH, Parameter.TRACK_GROWTH])),
        improvement=best.improvement, delays=delays, gyro_bias=best.gyro_bias, notes=tuple(notes),
        odometry=settings(
            known, float(result.values[SEPARATION]), best.stays_configured,
            log_noise if log_noise is not None and log_noise.better else None, scaled=bool(scale),
        ),
        stays_configured=tuple(best.stays_configured), noise=log_noise,
    )  # fmt: skip


def _stays(name: str, deviation: float) -> str:
    known = f" (standard deviation in this log: {deviation:.1%})" if deviation < 1.0 else ""
    return f"{name} stays as configured, because this log does not improve it{known}"


def _of_noise(log_noise: LogNoise | None) -> Iterator[str]:
    if log_noise is None or not log_noise.better:
        yield (
            "the odometry's variances per metre and per radian stay as configured, because the "
            "errors of another drive may differ from those of this log"
        )
    elif not log_noise.places:
        yield (
            "the settings for random errors of the distance stay as configured, because only "
            "positions show these errors, and a gyro does not"
        )


def _cuts(driven: Sequence[Run]) -> Iterator[str]:
    if gaps := sum(len(run.gaps) for run in driven):
        yield f"the wheel speeds have {gaps} gaps: the tool uses no data across them"
    if jumps := sum(len(positions.jumps(run)) for run in driven):
        yield (
            f"the positions jump {jumps} times (outliers, or a source that corrected "
            "itself): the tool uses no data across the jumps"
        )


def _too_good(made: Prepared, fitted: Fit, log: Log) -> Iterator[str]:
    rows, headings, base = made.rows, made.headings, made.base
    if headings is not None:
        off = rows.turned - heading.turned(rows, base, fitted.parameters)
        off -= np.median(off / rows.seconds) * rows.seconds
        if float(off @ off) < MIN_DIFFERENCE**2 * float(rows.turned @ rows.turned):
            yield _copied_from_wheels(headings.source)
    if made.segments and not log.true_positions:
        along = [positions.path(steps, base, fitted.parameters) for steps in made.steps]
        reach = max(positions.extent(segment.place) for segment in made.segments)
        if positions.spread(made.segments, along) < MIN_DIFFERENCE * reach:
            yield _copied_from_wheels("the positions")


def _copied_from_wheels(what: str) -> str:
    return (
        f"{what}: these values agree better with the wheels than a sensor can. If they were "
        "computed from the same wheels, like the odometry of a motor driver, the result describes "
        "the settings of that driver and not the robot; use a gyro, SLAM, GPS or motion capture"
    )


def _follow(made: Prepared, fitted: Fit, rate: Rates) -> Follow:
    def follow(values: Floats, number: int) -> Extent:
        parameters = fitted.parameters.copy()
        parameters[RADII] = values[[LEFT_RADIUS, RIGHT_RADIUS]]
        parameters[Parameter.INVERSE_TRACK] = 1 / (
            values[SEPARATION] * (1 - parameters[Parameter.TRACK_GROWTH] * rate.mean)
        )
        steps = positions.wheel_steps(made.runs[number])
        place = positions.path(steps, made.base, parameters).place
        return Extent(float(abs(place[-1])), float(np.abs(np.diff(place)).sum()))

    return follow
