"""The three output forms of a calibration agree."""

from __future__ import annotations

import msgspec
from msgspec import structs

from acsard.calibration.calibration_report import NAMES, CalibrationReport, keys, parts, report
from acsard.calibration.plausibility import RATIO, TRACK
from acsard.core.config.parsing import parse
from acsard.core.config.settings import DriveConfig
from acsard.core.config.toml_text import excerpt
from acsard.terminal.output import MAX_TEXT_WIDTH, plain
from tests.unit.calibration.cut import calibrated, table, usual

FOUND = calibrated(table(usual(), places=False))
REPORT = report("a.csv", FOUND, DriveConfig(), "")


def test_the_report_has_every_parameter_with_its_deviation() -> None:
    made = msgspec.to_builtins(REPORT)
    for name, value, std in zip(
        NAMES, FOUND.multipliers.values, FOUND.multipliers.std, strict=True
    ):
        assert (made[name], made[f"{name}_std"]) == (value, std)
    assert made["effective_track"] == made["wheel_separation_multiplier"] * 0.3
    assert made["turn_error_before"] > 200 > 30 > made["turn_error_after"]
    assert made["refused"] is None


def test_the_excerpt_is_a_configuration_with_the_found_values() -> None:
    made = parse("\n".join(excerpt(keys(FOUND))).encode())
    assert made.drive.wheel_separation_multiplier == round(REPORT.wheel_separation_multiplier, 5)
    for name, value in REPORT.odometry.items():
        assert getattr(made.odometry, name) == value > 0.0


def test_the_deviation_of_an_unmeasured_scale_is_not_written() -> None:
    assert "distance_scale_std" not in REPORT.odometry


def test_the_text_states_the_improvement_and_the_remaining_error() -> None:
    text = plain(*parts(REPORT, FOUND, "acsard.toml", guided=False), width=MAX_TEXT_WIDTH)
    assert "wheel_separation_multiplier   " in text
    assert f"heading error after a turn of 360 deg: {REPORT.turn_error_before:.0f} deg now" in text
    assert "remaining error: skidding changes the effective track. This log determines " in text
    assert "with the new values\n(errors on drives that the fit did not use)\nrandom " in text
    assert "give --distance METERS" in text


def printed(made: CalibrationReport) -> str:
    return plain(*parts(made, FOUND, "acsard.toml", guided=False), width=9999)


def test_a_change_of_the_track_with_the_turn_rate_is_stated_only_beyond_its_uncertainty() -> None:
    fastest = FOUND.drives.fastest
    measured = structs.replace(
        REPORT,
        effective_track_growth=0.031 / fastest,
        effective_track_growth_std=0.015 / fastest,
    )
    text = printed(measured)
    assert "skidding changes the effective track. " in text
    assert "From slow to fast turns, it changes by +3.1% (+- 1.5%). The track also" in text
    text = printed(structs.replace(measured, effective_track_growth=0.029 / fastest))
    assert "it changes by" not in text
    assert "skidding may change the effective track. " in text
    shown = "This log shows no change from slow to fast turns beyond the uncertainty"
    assert f"{shown} (2 standard deviations: 3.0%). The track also" in text
    # The fit does not determine the change if it keeps the track as configured.
    kept = structs.replace(
        REPORT, effective_track_growth=0.0, effective_track_growth_std=3e-5, kept=(TRACK,)
    )
    text = printed(kept)
    assert "skidding may change the effective track. The track also depends on the ground" in text


def test_a_value_that_the_log_does_not_determine_is_shown_as_configured() -> None:
    """Its deviation is not "as configured", because the noise settings may replace it."""
    found = structs.replace(FOUND, multipliers=FOUND.configured, stays_configured=(TRACK, RATIO))
    made = report("a.csv", found, DriveConfig(), "")
    lines = plain(*parts(made, found, "acsard.toml", guided=False), width=99).splitlines()
    rows = [line.split(maxsplit=2) for line in lines if "1.0000" in line]
    assert [row[0] for row in rows] == list(NAMES)
    assert [row[2].split() for row in rows] == [["as", "configured", "-"]] * 3
    (track,) = (line for line in lines if line.startswith("effective track, m"))
    assert track.split()[-4:] == ["0.3000", "as", "configured", "-"]


def test_a_size_by_tape_is_shown_although_the_log_does_not_determine_the_ratio() -> None:
    values = FOUND.configured.values * (1.0, 1.02, 1.02)
    found = structs.replace(
        FOUND,
        multipliers=structs.replace(FOUND.configured, values=values),
        stays_configured=(TRACK, RATIO),
    )
    made = report("a.csv", found, DriveConfig(), "")
    text = plain(*parts(made, found, "acsard.toml", guided=False), width=99)
    assert text.count("1.0200  -") == 2


def test_a_guided_calibration_does_not_advise_an_option_that_needs_a_log() -> None:
    text = plain(*parts(REPORT, FOUND, "acsard.toml", guided=True), width=9999)
    assert "--distance" not in text
    assert "calibrate with --method tape, or with --method gyro and type the distance" in text


def test_the_notes_come_after_the_result() -> None:
    made = structs.replace(REPORT, notes=["one"])
    text = plain(*parts(made, FOUND, "acsard.toml", guided=False), width=99)
    assert text.rstrip().endswith("note: one")
    assert text.index("wheel_separation_multiplier =") < text.index("note: one")
