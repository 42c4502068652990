"""A calibration in words for people, as one object for programs, and as lines for `acsard.toml`."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence

from msgspec import Struct

from acsard.calibration.multipliers import SEPARATION
from acsard.calibration.solve import Calibration
from acsard.config.settings import DriveConfig
from acsard.config.writing import excerpt

NAMES = (
    "wheel_separation_multiplier", "left_wheel_radius_multiplier", "right_wheel_radius_multiplier",
)  # fmt: skip
"""In the order of `Multipliers.values`."""

DIGITS = 5
"""Behind the point, of what is written."""

MOST_STD = 1.0
"""The largest that the configuration takes."""


class Refusal(Struct, frozen=True):
    """What `--json` prints when the log gives nothing: why, and what was told of it until then."""

    log: str
    refused: str
    notes: Sequence[str] = ()


class Report(Struct, frozen=True):
    """What `--json` prints. Multipliers and their standard deviations are pure numbers; errors are
    those now and with the multipliers found, on parts of the log left out of the fit, None where
    nothing tells them."""

    log: str
    way: str
    """What the wheels were compared with."""
    scale: str
    """What measured the wheels' size; "" is nothing: then their mean stays as configured."""
    wheel_separation_multiplier: float
    left_wheel_radius_multiplier: float
    right_wheel_radius_multiplier: float
    wheel_separation_multiplier_std: float
    left_wheel_radius_multiplier_std: float
    right_wheel_radius_multiplier_std: float
    covariance: Sequence[Sequence[float]]
    """Of the three multipliers, in this order."""
    odometry: dict[str, float]
    """The standard deviations as `[odometry]` takes them: of each apart from what all three have in
    common, and of that."""
    effective_track: float
    """m"""
    effective_track_std: float
    effective_track_growth: float
    """Share by which it grows with each rad/s of turn rate."""
    effective_track_growth_std: float
    left_wheel_radius: float
    """m"""
    right_wheel_radius: float
    turn_error_before: float | None
    """deg after a turn of 360 deg."""
    turn_error_after: float | None
    straight_error_before: float | None
    """deg after 10 m straight on."""
    straight_error_after: float | None
    position_error_before: float | None
    """m rms over a few seconds."""
    position_error_after: float | None
    time_offsets: dict[str, float]
    """s by which each sensor is later than the wheels."""
    gyro_bias: float
    """rad/s"""
    runs: int
    seconds: float
    distance: float
    """m rolled ahead and back."""
    turns: float
    """Of 360 deg, to both sides."""
    notes: Sequence[str]
    written: str | None
    """The file that has the multipliers now."""
    refused: None = None


def report(log: str, found: Calibration, drive: DriveConfig, written: str) -> Report:
    """Put together."""
    track, left, right = found.found.values.tolist()
    track_std, left_std, right_std = found.found.std.tolist()
    gain, drives = found.gain, found.drives
    return Report(
        log=log, way=found.way, scale=found.scale,
        wheel_separation_multiplier=track, wheel_separation_multiplier_std=track_std,
        left_wheel_radius_multiplier=left, left_wheel_radius_multiplier_std=left_std,
        right_wheel_radius_multiplier=right, right_wheel_radius_multiplier_std=right_std,
        covariance=found.found.covariance.tolist(), odometry=deviations(found),
        effective_track=track * drive.wheel_separation,
        effective_track_std=track_std * drive.wheel_separation,
        effective_track_growth=found.growth, effective_track_growth_std=found.growth_std,
        left_wheel_radius=left * drive.wheel_radius, right_wheel_radius=right * drive.wheel_radius,
        turn_error_before=gain.turn.now, turn_error_after=gain.turn.then,
        straight_error_before=gain.straight.now, straight_error_after=gain.straight.then,
        position_error_before=gain.place.now, position_error_after=gain.place.then,
        time_offsets=found.late, gyro_bias=found.bias,
        runs=drives.runs, seconds=drives.seconds, distance=drives.metres, turns=drives.turns,
        notes=found.notes, written=written or None,
    )  # fmt: skip


def keys(found: Calibration) -> dict[str, object]:
    """What `--write` sets: dotted keys."""
    wanted: dict[str, object] = {
        f"drive.{name}": round(float(value), DIGITS)
        for name, value in zip(NAMES, found.found.values, strict=True)
    }
    return wanted | {f"odometry.{name}": value for name, value in deviations(found).items()}


def deviations(found: Calibration) -> dict[str, float]:
    """The keys of `[odometry]`. Of a scale that nothing has measured there is nothing to say."""
    own, scale = found.found.own()
    given = {f"{name}_std": float(value) for name, value in zip(NAMES, own, strict=True)}
    if found.scale:
        given["distance_scale_std"] = scale
    return {name: round(min(value, MOST_STD), DIGITS) for name, value in given.items()}


def text(found: Report, calibration: Calibration, where: str) -> str:
    """For people."""
    return "\n".join(_text(found, calibration, where))


def _text(found: Report, calibration: Calibration, where: str) -> Iterator[str]:
    drives = calibration.drives
    yield (
        f"{found.log}: {drives.runs} run{'s' if drives.runs > 1 else ''}, {drives.seconds:.0f} s, "
        f"{drives.metres:.1f} m, {drives.turns:.1f} turns at up to {drives.fastest:.2f} rad/s; "
        f"compared with {found.way}"
    )
    yield ""
    yield f"{'':<31}{'now':>8}{'found':>10}   standard deviation"
    now, then = calibration.now, calibration.found
    for name, was, value, std in zip(NAMES, now.values, then.values, then.std, strict=True):
        yield f"{name:<31}{was:>8.4f}{value:>10.4f}   {std:.4f}"
    was = found.effective_track / then.values[SEPARATION] * now.values[SEPARATION]
    yield (
        f"{'effective track, m':<31}{was:>8.4f}{found.effective_track:>10.4f}   "
        f"{found.effective_track_std:.4f}"
    )
    yield ""
    yield from _wrapped(_better(found))
    yield ""
    yield from _wrapped(_remains(found, calibration))
    yield from _wrapped([f"note: {note}" for note in found.notes])
    yield ""
    yield f"{where}: written" if found.written else "for acsard.toml (or --write):"
    yield from excerpt(keys(calibration))


def _wrapped(sentences: Sequence[str]) -> Iterator[str]:
    for sentence in sentences:
        yield from textwrap.wrap(sentence, 100, subsequent_indent="  ")


def _better(found: Report) -> list[str]:
    """What improves, as it was seen where it was not fitted."""
    told = []
    for before, after, words, unit, factor in (
        (found.turn_error_before, found.turn_error_after,
         "a turn of 360 deg ends {} off now, {} then", "deg", 1),
        (found.straight_error_before, found.straight_error_after,
         "10 m straight on end turned by {} more than odometry says now, {} then", "deg", 1),
        (found.position_error_before, found.position_error_after,
         "over a few seconds odometry leaves the positions by {} now, {} then", "cm", 100),
    ):  # fmt: skip
        if before is not None and after is not None:
            told.append(
                words.format(f"{_two(before * factor)} {unit}", f"{_two(after * factor)} {unit}")
            )
    return [*told, "(measured on parts of the log that were left out of the fit)"] if told else []


def _two(value: float) -> str:
    """Two digits that say something, never an exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.1f}" if value >= 1 else f"{value:.2f}"


def _remains(found: Report, calibration: Calibration) -> list[str]:
    """What the calibration cannot take away."""
    fastest = calibration.drives.fastest
    share = calibration.found.std[SEPARATION] / calibration.found.values[SEPARATION]
    told = [
        f"what remains: the effective track is no constant on wheels that skid; here it is sure to "
        f"{share:.1%}, and changes by {found.effective_track_growth * fastest:+.1%} (+- "
        f"{found.effective_track_growth_std * fastest:.1%}) from slow turns to fast ones. Other "
        "ground has another: calibrate where you drive"
    ]
    if not found.scale:
        told.append(
            "the size of the wheels was not measured, only left to right: distances are as right "
            "as drive.wheel_radius is. Drive 2 m or more straight on and give --distance METRES"
        )
    return told
