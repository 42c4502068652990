"""The three output forms of a calibration agree."""

from __future__ import annotations

import msgspec
from msgspec import structs

from acsard.calibration.calibration_report import NAMES, keys, parts, report
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


def test_a_guided_calibration_does_not_advise_an_option_that_needs_a_log() -> None:
    text = plain(*parts(REPORT, FOUND, "acsard.toml", guided=True), width=9999)
    assert "--distance" not in text
    assert "calibrate with --method tape, or with --method gyro and type the distance" in text


def test_the_notes_come_after_the_result() -> None:
    made = structs.replace(REPORT, notes=["one"])
    text = plain(*parts(made, FOUND, "acsard.toml", guided=False), width=99)
    assert text.rstrip().endswith("note: one")
    assert text.index("wheel_separation_multiplier =") < text.index("note: one")
