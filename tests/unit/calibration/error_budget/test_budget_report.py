"""Tests of the error budget as text."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace

from acsard.calibration.error_budget.budget import Basis, Budget, Cause, Share
from acsard.calibration.error_budget.budget_report import advice, parts
from acsard.terminal.output import MAX_TEXT_WIDTH, plain
from tests.each import each

DRIVEN = Budget(
    10.0, 4.0, 400.0, 1000, 3, 0.25, 0.004, 0.01, 0, gyro=False, still=False,
    at_rest=(1e-4, 5e-4), shares=(),
)  # fmt: skip


def of(*shares: tuple[Cause, float | None, Basis], **fields: Any) -> Budget:
    """Return a budget with these shares: cause, error in mm per 100 m, and basis."""
    made = tuple(Share(cause, mm, mm, basis) for cause, mm, basis in shares)
    return replace(DRIVEN, shares=made, **fields)


def text(budget: Budget) -> str:
    return plain(*parts(budget), width=MAX_TEXT_WIDTH)


KNOWN: tuple[Cause, float, Basis] = ("parameters", 5.0, "settings")


@each(
    ("cause", "phrase"),
    [
        ("time", "latency_timer"),
        ("quantization", "link_check"),
        ("gaps", "3 feedback lines were lost, so 0.25 s"),
        ("slip", "gyro"),
        ("gyro", "stand"),
        ("parameters", "acsard calibrate"),
    ],
)
def test_one_sentence_advises_on_the_largest_measured_cause(cause: Cause, phrase: str) -> None:
    sentence = advice(of((cause, 100.0, "measured"), KNOWN))
    assert sentence.startswith(f"the largest measured cause of errors is {cause}: ")
    assert phrase in sentence


def test_the_counts_of_coarse_encoders_are_named() -> None:
    assert "40 counts" in advice(of(("quantization", 100.0, "measured"), KNOWN, counts=40))


def test_coarse_encoders_without_configured_counts_come_first() -> None:
    sentence = advice(of(("time", 100.0, "measured"), KNOWN, coarse=True))
    assert sentence.startswith("the encoders are coarse")
    assert "as mcu.encoder_counts" in sentence


def test_a_larger_cause_from_the_settings_does_not_hide_the_measured_one() -> None:
    sentence = advice(of(("slip", 900.0, "settings"), ("time", 50.0, "measured"), KNOWN))
    assert sentence.startswith(
        "according to the settings in [odometry], the largest cause of errors is slip"
    )
    assert "the largest measured cause of errors is time" in sentence


def test_the_advice_for_a_robot_without_calibration_comes_first() -> None:
    sentence = advice(of(("time", 50.0, "measured"), ("parameters", None, "unknown")))
    assert sentence.startswith(
        "the errors of the configured wheel radii and track width are unknown"
    )
    assert "the largest measured cause of errors is time" in sentence


def test_the_advice_says_if_there_is_no_error() -> None:
    assert advice(of()) == "no cause of errors was measured on this drive"


def test_the_table_has_every_cause_and_their_sum() -> None:
    rows = text(of(("time", 30.0, "measured"), ("slip", 40.0, "settings"))).splitlines()
    assert next(row for row in rows if row.startswith("time")).split()[1:3] == ["30", "30.00"]
    assert next(row for row in rows if row.startswith("slip")).endswith("[odometry]")
    assert next(row for row in rows if row.startswith("all")).split()[1:3] == ["50", "50.00"]
    assert max(map(len, rows)) <= MAX_TEXT_WIDTH


def test_an_unknown_share_is_a_dash_and_a_tiny_share_is_not_a_zero() -> None:
    rows = text(of(("time", 0.01, "measured"), ("gaps", None, "unknown"))).splitlines()
    assert next(row for row in rows if row.startswith("time")).split()[1] == "<1"
    assert next(row for row in rows if row.startswith("gaps")).split()[1:3] == ["-", "-"]


@pytest.mark.parametrize("still", [False, True])
def test_the_table_states_the_track_learned_by_the_gyro_and_the_configured_one(still: bool) -> None:
    result = of(KNOWN, learned=1.7, learned_std=0.05, multiplier=1.5, still=still)
    output = " ".join(text(result).split())
    assert (
        "multiplier should be 1.700 (standard deviation 0.050). Odometry uses the configured value,"
        in output
    )
    assert "value, 1.500. If the two values differ" in output
    assert "should be" not in text(of(KNOWN, still=still))
    output = " ".join(text(replace(result, learned_used=True)).split())
    assert (
        "multiplier should be 1.700 (standard deviation 0.050). Odometry uses this value" in output
    )
    assert "the configured value is 1.500." in output


def test_the_table_of_a_standing_robot_has_the_shares_by_settings_and_asks_to_drive() -> None:
    output = text(of(("parameters", 7.2, "settings"), still=True))
    assert "stands still" in output
    assert "0.10 mm/s" in output
    assert "7.20 deg in a full turn" in output
    assert "Drive the robot" in output
    assert "never calibrated" in text(of(("parameters", None, "unknown"), still=True))
