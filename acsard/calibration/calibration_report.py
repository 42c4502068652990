"""Shows a calibration as text, as an object for `--json`, and as lines for `acsard.toml`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from msgspec import Struct
from rich.console import RenderableType

from acsard.calibration.improvement import NOT_COMPARED, SURE_DEVIATIONS, BeforeAfter
from acsard.calibration.multipliers import SEPARATION
from acsard.calibration.odometry_noise import REPORT_DISTANCE_M
from acsard.calibration.plausibility import RATIO, TRACK
from acsard.calibration.solve import Calibration
from acsard.core.config.settings import DriveConfig
from acsard.core.config.toml_text import excerpt
from acsard.core.formatting import many
from acsard.core.values import Metres, RadPerS
from acsard.terminal.output import table

# Settings of `[drive]`, in the order of `Multipliers.values`.
NAMES = (
    "wheel_separation_multiplier", "left_wheel_radius_multiplier", "right_wheel_radius_multiplier",
)  # fmt: skip

DIGITS = 5  # of the settings that are written into `acsard.toml`


MIN_GROWTH = 0.0005  # a smaller change would appear as 0.0 %


class CalibrationRefusal(Struct, frozen=True):
    """The object that `--json` prints if a log gives no calibration."""

    log: str
    refused: str  # why the log gives no calibration, and what the user must do
    notes: Sequence[str] = ()


class CalibrationReport(Struct, frozen=True):
    """The object that `--json` prints for a calibration.

    A pair of fields `..._before` and `..._after` is the error of the odometry with the configured
    and with the new values, on drives that the fit did not use. `..._noise_...` is the standard
    deviation of the random error after 10 m, as the noise settings state it. Both are None if the
    log does not show them.
    """

    log: str
    reference: str  # names of the sensors, or of the measuring tool, as in `Calibration.reference`
    # As in `Calibration.scale`; if "", the mean radius stays as configured.
    scale: str
    wheel_separation_multiplier: float
    left_wheel_radius_multiplier: float
    right_wheel_radius_multiplier: float
    # Standard deviation of the multiplier; None if the track stays as configured.
    wheel_separation_multiplier_std: float | None
    # Standard deviation of the multiplier; None if the ratio of the radii stays as configured.
    left_wheel_radius_multiplier_std: float | None
    right_wheel_radius_multiplier_std: float | None
    # Of wheel separation, left radius and right radius, shape (3, 3).
    covariance: Sequence[Sequence[float]]
    # New values for settings of `[odometry]`, as in `Calibration.odometry`, but rounded.
    odometry: dict[str, float]
    # New values for settings of `[feedback]`, as in `Calibration.feedback`.
    feedback: dict[str, float]
    # Effective track: the distance between left and right wheels that explains the turns.
    effective_track: Metres
    effective_track_std: float | None
    # Fraction by which the effective track grows for each rad/s of turn rate.
    effective_track_growth: float
    effective_track_growth_std: float
    left_wheel_radius: Metres  # radius of the left wheels
    right_wheel_radius: Metres  # radius of the right wheels
    # Heading error after a turn of 360 deg with the configured multipliers, deg.
    turn_error_before: float | None
    turn_error_after: float | None
    # Heading error after 10 m straight ahead with the configured multipliers, deg.
    straight_error_before: float | None
    straight_error_after: float | None
    # RMS heading error over whole drives with the configured multipliers, deg.
    heading_error_before: float | None
    heading_error_after: float | None
    # RMS position error over whole drives with the configured multipliers.
    position_error_before: Metres | None
    position_error_after: float | None
    # Random error of the heading with the configured noise settings, deg.
    heading_noise_before: float | None
    heading_noise_after: float | None
    # Random error of the distance with the configured noise settings.
    distance_noise_before: Metres | None
    distance_noise_after: float | None
    # Delay of each sensor's recorded times, s, by sensor name, as in `Calibration.delays`.
    time_offsets: dict[str, float]
    gyro_bias: RadPerS  # gyro bias; 0 without a gyro
    runs: int
    seconds: float
    distance: Metres  # total distance driven, forwards and backwards
    turns: float  # total turning to the left and to the right, as a number of turns of 360 deg
    # Names of the quantities that stay as configured, because the log does not improve them.
    kept: Sequence[str]
    notes: Sequence[str]
    # Name of the file to which the tool wrote the new settings; None if the tool wrote no file.
    written: str | None
    refused: None = None


def report(
    log: str, calibration: Calibration, drive: DriveConfig, written: str
) -> CalibrationReport:
    """Return the object that `--json` prints for a calibration.

    `log` is the path of the log file, or "the drive" for a guided drive. `written` is the name of
    the changed file, or "".
    """
    multipliers = calibration.multipliers
    track, left, right = multipliers.values.tolist()
    track_std, left_std, right_std = _deviations(calibration)
    improvement, drives = calibration.improvement, calibration.drives
    heading, distance = _noise(calibration)
    return CalibrationReport(
        log=log, reference=calibration.reference, scale=calibration.scale,
        wheel_separation_multiplier=track, wheel_separation_multiplier_std=track_std,
        left_wheel_radius_multiplier=left, left_wheel_radius_multiplier_std=left_std,
        right_wheel_radius_multiplier=right, right_wheel_radius_multiplier_std=right_std,
        covariance=multipliers.covariance.tolist(), odometry=odometry(calibration),
        feedback=calibration.feedback,
        effective_track=track * drive.wheel_separation,
        effective_track_std=None if track_std is None else track_std * drive.wheel_separation,
        effective_track_growth=calibration.growth,
        effective_track_growth_std=calibration.growth_std,
        left_wheel_radius=left * drive.wheel_radius, right_wheel_radius=right * drive.wheel_radius,
        turn_error_before=improvement.turn.before, turn_error_after=improvement.turn.after,
        straight_error_before=improvement.straight.before,
        straight_error_after=improvement.straight.after,
        heading_error_before=improvement.heading.before,
        heading_error_after=improvement.heading.after,
        position_error_before=improvement.place.before,
        position_error_after=improvement.place.after,
        heading_noise_before=heading.before, heading_noise_after=heading.after,
        distance_noise_before=distance.before, distance_noise_after=distance.after,
        time_offsets=calibration.delays, gyro_bias=calibration.gyro_bias,
        runs=drives.runs, seconds=drives.seconds, distance=drives.metres, turns=drives.turns,
        kept=calibration.stays_configured, notes=calibration.notes, written=written or None,
    )  # fmt: skip


def _noise(calibration: Calibration) -> tuple[BeforeAfter, BeforeAfter]:
    noise = calibration.noise
    if noise is None or not noise.better:
        return NOT_COMPARED, NOT_COMPARED
    heading = BeforeAfter(*(math.degrees(angle) for angle in noise.heading()))
    return heading, BeforeAfter(*noise.distance()) if noise.places else NOT_COMPARED


def _deviations(calibration: Calibration) -> list[float | None]:
    named = zip((TRACK, RATIO, RATIO), calibration.multipliers.std.tolist(), strict=True)
    return [None if name in calibration.stays_configured else std for name, std in named]


def keys(calibration: Calibration) -> dict[str, object]:
    """Return the new values that `--write` writes, by dotted key of the configuration."""
    wanted: dict[str, object] = {
        f"drive.{name}": round(float(value), DIGITS)
        for name, value in zip(NAMES, calibration.multipliers.values, strict=True)
    }
    wanted |= {f"odometry.{name}": value for name, value in odometry(calibration).items()}
    return wanted | {f"feedback.{name}": value for name, value in calibration.feedback.items()}


def odometry(calibration: Calibration) -> dict[str, float]:
    """Return the new values for settings of `[odometry]`, rounded to `DIGITS` digits."""
    return {name: float(f"{value:.{DIGITS - 1}g}") for name, value in calibration.odometry.items()}


def parts(
    report: CalibrationReport, calibration: Calibration, where: str, *, guided: bool
) -> Iterator[RenderableType]:
    """Yield the parts of the printed report: sentences, and a table of the multipliers."""
    drives = calibration.drives
    yield (
        f"{report.log}: {many(drives.runs, 'run')}, {drives.seconds:.0f} s, "
        f"{drives.metres:.1f} m, {drives.turns:.1f} turns at up to {drives.fastest:.2f} rad/s; "
        f"the wheels were compared with {report.reference}"
    )
    now, new = calibration.configured, calibration.multipliers
    was = report.effective_track / new.values[SEPARATION] * now.values[SEPARATION]
    figures = [
        *zip(NAMES, now.values, new.values, _deviations(calibration), strict=True),
        ("effective track, m", was, report.effective_track, report.effective_track_std),
    ]
    rows = [_row(name, float(old), float(value), std) for name, old, value, std in figures]
    yield from ("", table(rows, ("", "now", "found", "standard deviation"), right={1, 2}), "")
    yield from _better(report)
    yield ""
    yield from _remains(report, calibration, guided=guided)
    yield from (
        "",
        f"{where}: written"
        if report.written
        else "settings for acsard.toml (--write writes them):",
    )
    yield from excerpt(keys(calibration))
    if report.notes:
        yield ""
    yield from (f"note: {note}" for note in report.notes)


def _row(name: str, old: float, value: float, std: float | None) -> tuple[str, str, str, str]:
    now, found = f"{old:.4f}", f"{value:.4f}"
    if std is not None:
        return name, now, found, f"{std:.4f}"
    return name, now, "as configured" if found == now else found, "-"


def _better(report: CalibrationReport) -> list[str]:
    noise = (
        f"random {{}} error after {REPORT_DISTANCE_M:g} m of driving, "
        "according to the odometry messages"
    )
    errors = _compared(
        (report.turn_error_before, report.turn_error_after,
         "heading error after a turn of 360 deg", "deg", 1),
        (report.straight_error_before, report.straight_error_after,
         "heading error after 10 m straight ahead", "deg", 1),
        (report.heading_error_before, report.heading_error_after,
         "heading error over whole drives", "deg", 1),
        (report.position_error_before, report.position_error_after,
         "position error over whole drives", "cm", 100),
    )  # fmt: skip
    random = _compared(
        (report.heading_noise_before, report.heading_noise_after,
         noise.format("heading"), "deg", 1),
        (report.distance_noise_before, report.distance_noise_after,
         noise.format("distance"), "cm", 100),
    )  # fmt: skip
    unused = ["(errors on drives that the fit did not use)"] if errors else []
    return [*errors, *unused, *random]


def _compared(*rows: tuple[float | None, float | None, str, str, int]) -> list[str]:
    return [
        f"{words}: {_two(before * factor)} {unit} now, {_two(after * factor)} {unit} with the new "
        "values"
        for before, after, words, unit, factor in rows
        if before is not None and after is not None
    ]


def _two(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.1f}" if value >= 1 else f"{value:.2f}"


def _remains(report: CalibrationReport, calibration: Calibration, *, guided: bool) -> list[str]:
    multipliers = calibration.multipliers
    share = multipliers.std[SEPARATION] / multipliers.values[SEPARATION]
    known = (
        ""
        if TRACK in report.kept
        else f"This log determines the track to {share:.1%} (standard deviation). "
    )
    verb, growth = _growth(report, calibration.drives.fastest)
    sentences = [
        f"remaining error: skidding {verb} the effective track. {known}{growth}The track also "
        "depends on the ground, so calibrate where you drive"
    ]
    if not report.scale:
        advice = (
            "calibrate with --method tape, or with --method gyro and type the distance that it "
            "asks for after the straight leg"
            if guided
            else "drive 2 m or more straight ahead, measure the distance, and give --distance "
            "METERS"
        )
        sentences.append(
            "the calibration compared only the left with the right wheels and did not measure "
            "their size, so distances are only as accurate as drive.wheel_radius. To measure the "
            f"size, {advice}"
        )
    return sentences


def _growth(report: CalibrationReport, fastest: float) -> tuple[str, str]:
    growth, std = report.effective_track_growth * fastest, report.effective_track_growth_std
    limit = SURE_DEVIATIONS * std * fastest
    if abs(growth) > max(limit, MIN_GROWTH):
        change = f"it changes by {growth:+.1%} (+- {std * fastest:.1%})"
        return "changes", f"From slow to fast turns, {change}. "
    if limit < MIN_GROWTH:
        return "may change", ""
    return "may change", (
        "This log shows no change from slow to fast turns beyond the uncertainty "
        f"({SURE_DEVIATIONS:g} standard deviations: {limit:.1%}). "
    )
