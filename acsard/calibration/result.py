"""Computes the result of `acsard calibrate`: the settings to write, and a sentence per decision.

A value is written only if it is better on runs that its fit did not use.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import combinations

import numpy as np
from msgspec import Struct
from rich.console import RenderableType

from acsard.calibration.comparison import Match, without
from acsard.calibration.fit import AGREES, Errors, Fit, fit
from acsard.calibration.geometry import LEFT, RIGHT, TRACK
from acsard.calibration.hypotheses import NAMES, examined, forward
from acsard.calibration.log import Log, LogError, Run, TapeReading
from acsard.calibration.noise import Noise, noise
from acsard.calibration.response import response_time
from acsard.calibration.series import Floats
from acsard.core.config.settings import Config
from acsard.core.config.toml_text import excerpt
from acsard.core.formatting import many
from acsard.core.values import Seconds
from acsard.terminal.output import table

# Drives beyond these are of another unit.
MAX_SPEED, MAX_TURNS = 10.0, 1000.0  # m/s, 360 deg
CONTRADICTION, CONTRADICTIONS = 0.1, 4.0  # of two tracks, as a fraction and in deviations
ALONE_RUNS = 40  # of many runs, these suffice to compare the tracks by two sensors
EXACT_TURN, EXACT_M = 3e-4 * math.tau, 3e-4  # errors below those of a sensor: of a turn, rad; m
MIN_ROLLED = 20.0  # rad, by the wheels of a log
# Share of its usual speed by which a wheel of a long log changes in 1 s: 0.5 and more of a robot
# that stops and turns, 0.13 of one whose t is in 1/100 s. And the share of the configured
# acceleration: a robot that may only drive gently does not reach the first one.
LONG_S, ABRUPT, GENTLE = 1000.0, 0.2, 0.1
DRIVE = (
    "stand for 3 s, drive 2 m ahead and back, turn three times to each side, slowly and fast, then "
    "drive curves: 60 s in all"
)

DIGITS = 5
MULTIPLIERS = {
    "wheel_separation_multiplier": TRACK, "left_wheel_radius_multiplier": LEFT,
    "right_wheel_radius_multiplier": RIGHT,
}  # fmt: skip
TRACK_NAME = "wheel_separation_multiplier"
SMALL = 0.01  # difference of a track or radius from the configured one
SHORT = 1.5  # times the configured response time, from which a longer one is written
MISREAD = 4.0  # deviations of a reading that does not fit the others
REPORT_M = 10.0  # of driving, for the sentence about noise


class Refusal(Struct, frozen=True):
    """The object that `--json` prints if a log gives no better value."""

    log: str
    refused: str  # why, and what to do
    notes: Sequence[str] = ()


class Result(Struct, frozen=True):
    """The object that `--json` prints for a calibration."""

    log: str
    reference: str  # the sensors with which the wheels were compared
    runs: int
    seconds: Seconds
    distance: float  # m
    turns: float  # of 360 deg
    found: dict[str, float]  # multipliers that fit best, by setting
    deviations: dict[str, float]  # their standard deviations
    better: bool  # the found multipliers are better on the runs that were left out
    turn_error: Errors | None  # of the heading after a turn of 360 deg, deg
    position_error: Errors | None  # m
    decisions: Sequence[str]  # a sentence each
    settings: dict[str, float]  # that `--write` writes, by dotted key
    notes: Sequence[str]
    written: str | None = None  # the file
    refused: None = None


def calibrate(log: Log, config: Config, source: str) -> Result:
    """Return the calibration of a log. Raises `LogError`, with the notes of the log attached."""
    try:
        _require_motion(log.runs, config)
        runs, matches, notes = examined(log.runs, config.drive)
        log = Log(tuple(runs), (*notes, *log.notes))
        alone = _fits_alone(runs, config, matches)
        _require_one_track(alone, config)
        found = fit(runs, config, matches)
        if not found.better and (vague := _vague(alone)):
            some = tuple(without(run, *vague) for run in runs)
            kept = {sensor: match for sensor, match in matches.items() if sensor not in vague}
            if (other := fit(some, config, kept)).better:
                words = [f"{NAMES[s]} is left out: no value is surely better by it" for s in vague]
                log, matches, found = Log(some, (*words, *log.notes)), kept, other
        if not found.tracked:
            fitted = " and ".join(NAMES.get(sensor, sensor) for sensor in found.sensors)
            raise LogError(
                f"the log does not show the track, because other tracks fit {fitted} as well: "
                + (forward(runs) or "drive on after each turn on the spot, and drive curves")
            )
        few = [f"{NAMES[sensor]} is left out, because it has too few values: 1 Hz or more is needed"
               for sensor in matches if sensor not in found.sensors]  # fmt: skip
        if found.halves:
            few.append(f"the halves of the log contradict each other by {found.halves:.0%}, which "
                       "widens the deviations: did the load, the tyres, the floor or the counts "
                       "change? Then calibrate each half alone")  # fmt: skip
        log = Log(log.runs, (*_too_good(found), *few, *log.notes))
        return _require_drive(_result(log, config, source, found))
    except LogError as error:
        for note in log.notes:
            error.add_note(note)
        raise


def _too_good(found: Fit) -> Iterator[str]:
    turns = next((NAMES[sensor] for sensor in found.sensors if sensor in ("gyro", "headings")), "")
    for name, errors, least in ((turns, found.turn, EXACT_TURN), ("x, y", found.place, EXACT_M)):
        if errors and errors.new < least:
            yield (
                f"{name} agrees with the wheels better than a sensor can: was it computed from "
                "them? (The true pose of the simulator agrees, too.)"
            )


def _require_motion(runs: Sequence[Run], config: Config) -> None:
    rolled = sum(float(np.abs(np.diff(side)).sum()) for r in runs for side in (r.left, r.right)) / 2
    if rolled < MIN_ROLLED:
        raise LogError(
            f"the wheels roll only {rolled:.1f} rad in this log. If the robot drove farther, t is "
            f"not in s, or the speeds of the wheels are not in rad/s; else {DRIVE}"
        )
    seconds = sum(run.seconds for run in runs)
    speeds = [np.diff(np.interp(run.edges(1.0), run.t, side)) for run in runs
              for side in (run.left, run.right)]  # fmt: skip
    usual = float(np.quantile(np.abs(np.concatenate(speeds)), 0.95))
    change = max(float(np.abs(np.diff(speed, prepend=speed[0])).max()) for speed in speeds)
    quick = GENTLE * config.limits.linear_acceleration / config.drive.wheel_radius
    if seconds > LONG_S and change < min(ABRUPT * usual, quick):
        raise LogError(
            f"in {seconds:.0f} s, no wheel changes by more than {change:.2f} rad/s within 1 s, but "
            "robots start and stop faster: is t in s, and not in 1/100 s or ms?"
        )


def _require_drive(result: Result) -> Result:
    # A drive that no robot makes is one in another unit.
    fast = result.distance > MAX_SPEED * result.seconds
    if result.turns > MAX_TURNS or fast:
        raise LogError(
            f"by t and the wheels the robot drives {result.distance:.0f} m and {result.turns:.0f} "
            f"turns in {result.seconds:.0f} s, which no robot does in a calibration: is t in s, "
            "are the speeds of the wheels in rad/s, and are drive.wheel_radius and "
            "drive.wheel_separation in m?"
        )
    return result


def _vague(alone: Mapping[str, Fit]) -> list[str]:
    # The sensors by which no value is better, and that know less than one by which values are. One
    # that knows more, or that contradicts it, may show that the configuration is right.
    certain = [found for found in alone.values() if found.better]
    if not certain:
        return []
    best = min(certain, key=lambda found: float(found.shares[0]))
    return [
        sensor for sensor, found in alone.items()
        if not found.better and found.shares[0] > best.shares[0]
        and (found.shares[0] > abs(_track(found) - _track(best)) or not found.tracked)
    ]  # fmt: skip


def _track(found: Fit) -> float:
    # The logarithm of the track beside the mean radius.
    return float(found.p[TRACK] - (found.p[LEFT] + found.p[RIGHT]) / 2)


def _fits_alone(
    runs: Sequence[Run], config: Config, matches: Mapping[str, Match]
) -> dict[str, Fit]:
    # The fit by each of several sensors.
    alone = dict[str, Fit]()
    if len(matches) < 2:
        return alone
    some = runs[:: 1 + len(runs) // ALONE_RUNS]
    for sensor, match in matches.items():
        others = [other for other in NAMES if other != sensor]
        with suppress(LogError):  # it has too few values
            alone[sensor] = fit([without(run, *others) for run in some], config, {sensor: match})
    return alone


def _require_one_track(alone: Mapping[str, Fit], config: Config) -> None:
    # Sensors that contradict each other are not mixed.
    values = {
        sensor: (_track(found), found.shares[0])
        for sensor, found in alone.items() if found.tracked
    }  # fmt: skip
    for (a, (track, std)), (b, (other, other_std)) in combinations(values.items(), 2):
        if abs(track - other) > max(CONTRADICTION, CONTRADICTIONS * math.hypot(std, other_std)):
            words = " and ".join(
                f"{math.exp(v) * config.drive.wheel_separation_multiplier:.3f} +- "
                f"{math.exp(v) * s:.3f} by {NAMES[sensor]}"
                for sensor, (v, s) in ((a, values[a]), (b, values[b]))
            )
            raise LogError(
                f"{NAMES[a]} and {NAMES[b]} contradict each other: the track is {words}, in wheel "
                "separations. Leave the column of the wrong sensor out"
            )


def _result(log: Log, config: Config, source: str, found: Fit) -> Result:
    base, p = found.base, found.p
    motion = [base.motion(p, *piece.rolls) for piece in found.pieces]
    configured = np.array([getattr(config.drive, name) for name in MULTIPLIERS])
    factors = np.exp(p[list(MULTIPLIERS.values())])
    # A track without the size of the wheels is one beside their mean radius.
    stds = np.sqrt(np.diag(found.covariance))[list(MULTIPLIERS.values())]
    if not found.sized:
        stds = np.where([name == TRACK_NAME for name in MULTIPLIERS], found.shares[0], stds)
    stds = stds * configured * factors
    shown = noise(log.runs, found, config.odometry, len(config.mcu.wheels.names))
    settings: dict[str, float] = {}
    decisions = [*_geometry(found, config, settings, shown)]
    misread = _misread(found, [run.name for run in log.runs])
    if found.better:  # the noise is that of the new geometry
        decisions += _noise(found, config, settings, shown)
    decisions += _response(log, config, settings)
    if not settings:
        off = np.abs(found.p[[LEFT, RIGHT, TRACK]])
        exact = any(_too_good(found))
        agrees = (
            not exact
            and (found.readings is None or found.readings.now <= AGREES)
            and bool(np.all(off < np.maximum(AGREES * np.sqrt(np.diag(found.covariance)), SMALL)))
        )
        verdict = (
            "Your robot agrees with its configuration" if agrees else "No value is surely better"
        )
        raise LogError("\n".join([misread or f"{verdict}: nothing to write.", *decisions]))
    if misread:
        decisions.append(misread)
    return Result(
        source, " and ".join(found.sensors), len(log.runs), sum(r.seconds for r in log.runs),
        sum(float(np.abs(d).sum()) for d, _ in motion),
        sum(float(np.abs(t).sum()) for _, t in motion) / math.tau,
        dict(zip(MULTIPLIERS, (configured * factors).tolist(), strict=True)),
        dict(zip(MULTIPLIERS, stds.tolist(), strict=True)), found.better,
        found.turn and Errors(math.degrees(found.turn.now), math.degrees(found.turn.new)),
        found.place, decisions,
        {key: float(f"{value:.{DIGITS}g}") for key, value in settings.items()},
        log.notes,
    )  # fmt: skip


def _geometry(
    found: Fit, config: Config, settings: dict[str, float], shown: Noise
) -> Iterator[str]:
    errors = [
        f"{words} {_two(e.new * factor)} {unit} instead of {_two(e.now * factor)} {unit}"
        for e, words, factor, unit in (
            (found.turn, "a turn of 360 deg errs by", 180 / math.pi, "deg"),
            (found.place, "positions err by", 100.0, "cm"),
            (found.readings, "your measurements differ from it by", 1.0, "of their usual error"),
        ) if e is not None
    ]  # fmt: skip
    if not found.better:
        yield (
            "Track and radii stay as configured, because new values are not clearly better on runs "
            f"that the fit did not use: {', '.join(errors)}."
        )
        return
    yield f"New track and radii are better on runs that the fit did not use: {', '.join(errors)}."
    for name, index in MULTIPLIERS.items():
        settings[f"drive.{name}"] = getattr(config.drive, name) * math.exp(found.p[index])
    track, ratio, scale = found.shares
    if shown.heading_better:
        width = found.base.track * math.exp(found.p[TRACK])
        track = math.hypot(track, math.sqrt(shown.track))
        ratio = math.hypot(ratio, width * math.sqrt(shown.ratio))
    if shown.distance_better:
        scale = math.hypot(scale, math.sqrt(shown.scale))
    settings["odometry.wheel_separation_multiplier_std"] = (
        track * settings["drive.wheel_separation_multiplier"]
    )
    settings["odometry.wheel_radius_ratio_std"] = ratio
    settings["odometry.distance_scale_std"] = scale
    yield (
        "The drives show the size of the wheels: distances are right to "
        f"{scale:.2%} (standard deviation)."
        if found.sized
        else "Turns do not show the size of the wheels, so distances are as right as "
        "drive.wheel_radius: measure a straight run with a tape (--distance)."
    )


def _misread(found: Fit, runs: Sequence[str]) -> str:
    # A sentence about readings that fit neither the configuration nor new values.
    if found.readings is None:
        return ""
    alone = np.eye(len(found.pieces), dtype=bool)
    worst = _worst(found, [found.p for _ in alone])
    if worst[0] <= MISREAD:
        if found.better or min(found.readings.now, found.readings.new) <= AGREES:
            return ""
        # The new values follow the wrong reading: compare it with what the others show.
        worst = _worst(found, [found.without(piece) for piece in alone])
    missed, reading, name = worst
    off, turn = missed * reading.std, reading.quantity == "turn"
    return (
        f"The measurements do not fit together: measure again. The {reading.quantity} of run "
        f"{runs.index(name) + 1} of {len(runs)} ({name}) is missed by "
        f"{f'{math.degrees(off):.0f} deg' if turn else f'{1000 * off:.0f} mm'}. Was it misread, or "
        f"the robot moved by hand{'' if turn else ', or is drive.wheel_radius wrong'}?"
    )


def _worst(found: Fit, parameters: Sequence[Floats]) -> tuple[float, TapeReading, str]:
    # The deviations of the reading that is missed most, with the parameters for each piece.
    return max(
        (
            (abs(float(missed)), reading, piece.run.name)
            for piece, p in zip(found.pieces, parameters, strict=True) if piece.run.tape
            for missed, reading in zip(piece.residuals(p)["tape"], piece.run.tape, strict=True)
        ), key=lambda row: row[0],
    )  # fmt: skip


def _noise(found: Fit, config: Config, settings: dict[str, float], shown: Noise) -> Iterator[str]:
    present = config.odometry
    now = _after(present.yaw_variance_per_metre, present.yaw_variance_per_radian)
    if shown.heading_better and shown.yaw_per_metre and shown.yaw_per_radian:
        settings["odometry.yaw_variance_per_metre"] = shown.yaw_per_metre
        settings["odometry.yaw_variance_per_radian"] = shown.yaw_per_radian
        new = _after(shown.yaw_per_metre, shown.yaw_per_radian)
        yield (
            f"The stated uncertainty of the heading becomes {_two(new)} deg after "
            f"{REPORT_M:g} m and one turn, where it is {_two(now)} deg, because that describes "
            "the runs better."
        )
    else:
        yield "The noise of the heading stays as configured: this log describes it no better."
    if shown.distance_better and shown.distance_per_metre:
        settings["odometry.distance_variance_per_metre"] = shown.distance_per_metre
        new, now = (
            100 * math.sqrt(v * REPORT_M)
            for v in (shown.distance_per_metre, present.distance_variance_per_metre)
        )
        yield (
            f"The stated uncertainty of the distance becomes {_two(new)} cm after {REPORT_M:g} m, "
            f"where it is {_two(now)} cm."
        )
    else:
        yield (
            "The noise of the distance stays as configured: only positions on straight ways "
            "show it."
        )


def _after(per_metre: float, per_radian: float) -> float:
    return math.degrees(math.sqrt(REPORT_M * per_metre + math.tau * per_radian))


def _response(log: Log, config: Config, settings: dict[str, float]) -> Iterator[str]:
    present = config.feedback.response_time
    seconds = response_time(log.runs, config.drive)
    if seconds is None:
        return
    if seconds > SHORT * present:
        settings["feedback.response_time"] = float(f"{seconds:.2g}")
        yield (
            f"The wheels follow their commands with a response time of {seconds:.2g} s, so the "
            f"configured {present:g} s would call healthy wheels faulty."
        )
    else:
        yield (
            f"The wheels follow their commands with a response time of {seconds:.2g} s, so "
            f"feedback.response_time = {present:g} s is long enough."
        )


def _two(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.1f}" if value >= 1 else f"{value:.2f}"


def text(result: Result, config: Config, where: str) -> Iterator[RenderableType]:
    """Yield the parts of the printed result. `where` is the configuration file."""
    yield (
        f"{result.log}: {many(result.runs, 'run')}, {result.seconds:.0f} s, {result.distance:.1f} "
        f"m, {result.turns:.1f} turns, compared with {result.reference}"
    )
    rows = [
        (name, f"{getattr(config.drive, name):.4f}", f"{value:.4f}",
         f"{result.deviations[name]:.4f}")
        for name, value in result.found.items()
    ]  # fmt: skip
    yield from ("", table(rows, ("", "now", "found", "standard deviation"), right={1, 2}), "")
    yield from result.decisions
    written = f"{where}: written"
    offered = "settings for acsard.toml (--write writes them):"
    yield from ("", written if result.written else offered, *excerpt(result.settings))
    if result.notes:
        yield ""
    yield from (f"note: {note}" for note in result.notes)
