"""Tests that turn tape readings and spins into parameters, and these into a calibration."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.calibration.calibration_report import keys, parts, report
from acsard.calibration.fit import Parameter
from acsard.calibration.guided.drive_plan import MAX_TRACK_RATIO, GuideError, Quantity
from acsard.calibration.guided.methods import MAX_SPIN_S, once_round, turns
from acsard.calibration.guided.tape_readings import (
    Reading,
    calibrated,
    fit_readings,
    joined,
    predicted,
    slant,
    track_ratio,
)  # fmt: skip
from acsard.calibration.log_table import NoCalibrationError
from acsard.calibration.runs import Run
from acsard.core.config.parsing import parse
from acsard.core.config.settings import DriveConfig
from acsard.core.config.toml_text import excerpt
from acsard.terminal.output import plain
from tests.unit.calibration.cut import BASE, IDEAL, log_of, table
from tests.unit.calibration.guided.played import Player, usual_setup
from tests.unit.calibration.robots import Plan, Robot, drive

SPIN: Plan = [(0.5, 0, 0), (15, 0, 1.2), (1, 0, 0)]
STRAIGHT: Plan = [(0.5, 0, 0), (6, 0.3, 0), (1, 0, 0)]
CURVE: Plan = [(0.5, 0, 0), (6, 0.3, 0.4), (1, 0, 0)]

TRUE = {"chi": 1.5, "left": 0.98, "right": 1.01}


def driven(plan: Plan) -> tuple[Run, complex, float]:
    """Return the wheel log of a robot without noise, its true end position and its true heading."""
    made = drive(replace(Robot(), **(IDEAL | TRUE)), plan)  # type: ignore[arg-type]
    run = log_of(table(made, gyro=False)).runs[0]
    return run, complex(made.where[-1]), float(made.yaw[-1])


def readings() -> list[Reading]:
    """Return exact readings of every kind."""
    spin, _, turned = driven(SPIN)
    straight, end, bent = driven(STRAIGHT)
    curve, _, curved = driven(CURVE)
    return [
        Reading((spin,), "turned", turned, 0.01),
        Reading((straight,), "distance", abs(end), 0.002),
        Reading((straight,), "angle", bent, 0.01),
        Reading((curve,), "angle", curved, 0.01),
    ]


def test_exact_readings_give_the_parameters_of_the_robot() -> None:
    result = fit_readings(readings(), BASE)
    assert 1 / result.parameters[Parameter.INVERSE_TRACK] == pytest.approx(1.5, rel=2e-3)
    assert result.parameters[Parameter.LEFT] == pytest.approx(0.98, rel=1e-3)
    assert result.parameters[Parameter.RIGHT] == pytest.approx(1.01, rel=1e-3)
    assert np.all(np.abs(result.residuals) < 3e-3)


def test_whole_turns_that_were_not_counted_do_not_matter() -> None:
    samples = readings()
    spin, _, turned = driven(SPIN)
    samples.append(Reading((spin,), "angle", math.remainder(turned, 2 * math.pi), 0.01))
    assert fit_readings(samples, BASE).parameters == pytest.approx(
        fit_readings(readings(), BASE).parameters, abs=3e-3
    )


@pytest.mark.parametrize("what", ["turned", "distance"])
def test_derivatives_are_those_of_small_steps(what: Quantity) -> None:
    """Compare the computed derivatives with finite differences.

    The computed derivatives ignore a small second-order effect of the rate parameter.
    """
    steps = joined([driven(CURVE)[0]])
    start = np.array([0.99, 1.01, 0.7, 0.03, 0.0, 0.0, 0.0])
    result = predicted(steps, what, BASE, start)
    for index in range(4):
        more = start.copy()
        more[index] += 1e-6
        derivative = (predicted(steps, what, BASE, more).value - result.value) / 1e-6
        assert result.derivatives[index] == pytest.approx(derivative, rel=0.02)


def test_rides_that_follow_each_other_are_joined_into_one() -> None:
    spin, _, turned = driven(SPIN)
    straight, end, bent = driven(STRAIGHT)
    parameters = np.array([0.98, 1.01, 1 / 1.5, 0.0, 0.0, 0.0, 0.0])
    steps = joined([spin, straight])
    assert np.all(np.diff(steps.t) > 0)
    assert predicted(steps, "turned", BASE, parameters).value == pytest.approx(
        turned + bent, abs=2e-3
    )
    far = predicted(steps, "distance", BASE, parameters).value
    assert far == pytest.approx(abs(end), abs=5e-3)


def test_readings_that_contradict_each_other_widen_the_deviation() -> None:
    exact, worse = readings(), readings()
    spin, _, turned = driven(SPIN)
    for measured, wrong in ((exact, 0.0), (worse, 0.6)):
        measured += [Reading((spin,), "turned", turned + side * wrong, 0.01) for side in (1, -1)]
    sure, unsure = (
        fit_readings(series, BASE).covariance[Parameter.INVERSE_TRACK, Parameter.INVERSE_TRACK]
        for series in (exact, worse)
    )
    assert unsure > 4 * sure


def test_readings_without_a_turn_are_refused() -> None:
    with pytest.raises(NoCalibrationError, match="hardly turned"):
        fit_readings([reading for reading in readings() if reading.quantity == "distance"], BASE)


def test_a_turn_to_the_other_side_than_that_of_the_wheels_is_refused() -> None:
    samples = readings()
    samples[0] = Reading(samples[0].rides, "turned", -samples[0].value, 0.01)
    with pytest.raises(NoCalibrationError, match="to the left"):
        fit_readings(samples, BASE)


@given(angle=st.floats(-1.3, 1.3), apart=st.floats(0.1, 1.0))
def test_two_distances_from_a_line_give_the_angle_to_it(angle: float, apart: float) -> None:
    """A turn to the left brings the front closer to a line on the robot's left."""
    half = apart / 2 * math.sin(angle)
    assert slant(1.0 - half, 1.0 + half, apart) == pytest.approx(angle, abs=1e-9)


def test_impossible_distances_from_a_line_are_refused() -> None:
    with pytest.raises(NoCalibrationError, match="measure again"):
        slant(0.1, 0.5, 0.25)


@pytest.mark.parametrize("track", [1.0, 1.7, MAX_TRACK_RATIO])
def test_a_first_turn_lasts_long_enough_for_the_widest_track(track: float) -> None:
    move = once_round(usual_setup()).moves[-1]
    assert move.angular * move.seconds / track > 2 * math.pi


@pytest.mark.parametrize("track", [1.0, 1.7, MAX_TRACK_RATIO])
@pytest.mark.parametrize("rate", [0.6, 1.2])
def test_the_number_of_turns_fits_into_the_time_for_turning(track: float, rate: float) -> None:
    setup = usual_setup()
    count = turns(setup, rate, track)
    assert 1 <= count <= 3
    assert setup.turn(2 * math.pi * count, rate, track).seconds <= MAX_SPIN_S


def once(chi: float) -> Reading:
    """Return the reading after a first turn of about one revolution by a robot with this track."""
    player = Player(replace(Robot(chi=chi), **IDEAL))  # type: ignore[arg-type]
    run = player.ride(once_round(usual_setup()))
    return Reading((run,), "turned", player.yaw, 0.01)


@pytest.mark.parametrize("chi", [1.0, 1.6, 2.4])
@pytest.mark.parametrize("multiplier", [1.0, 1.6])
def test_one_turn_gives_the_track_whatever_is_configured(chi: float, multiplier: float) -> None:
    drive = DriveConfig(wheel_separation_multiplier=multiplier)
    assert track_ratio(once(chi), drive) == pytest.approx(chi, rel=1e-3)


def test_a_turn_that_was_not_a_full_circle_is_reported() -> None:
    half = once(2.4)
    with pytest.raises(GuideError, match="exactly one turn"):
        track_ratio(Reading(half.rides, "turned", math.pi, 0.01), DriveConfig())


DRIVE = DriveConfig()


def test_the_errors_before_and_after_are_those_of_the_configured_and_found_values() -> None:
    made = calibrated(readings(), DRIVE)
    assert made.improvement.turn.before == pytest.approx(180, rel=0.05)
    assert made.improvement.turn.after is not None
    assert made.improvement.turn.after < 10
    assert made.drives.runs == 3
    assert made.drives.turns == pytest.approx(15 * 1.2 / 1.5 / 2 / np.pi, rel=0.15)


def test_the_report_names_the_tape_and_the_configuration_accepts_the_result() -> None:
    made = calibrated(readings(), DRIVE)
    text = plain(*parts(report("the drive", made, DRIVE, ""), made, "acsard.toml", guided=True))
    assert "compared with a tape" in text
    assert "heading error after a turn of 360 deg" in text
    config = parse("\n".join(excerpt(keys(made))).encode())
    assert config.drive.wheel_separation_multiplier == pytest.approx(1.5, rel=0.02)
    assert 0 < config.odometry.wheel_separation_multiplier_std < 0.2


def test_inaccurate_readings_are_refused() -> None:
    vague = [
        Reading(reading.rides, reading.quantity, reading.value, 100 * reading.deviation)
        for reading in readings()
    ]
    with pytest.raises(NoCalibrationError, match="too inaccurate"):
        calibrated(vague, DRIVE)
