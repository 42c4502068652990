"""Tests of the error budget against drives with exactly one cause of error."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise

import pytest
from msgspec.structs import replace

from acsard.calibration.error_budget.budget import Budget, Cause, DriveMessages, Share, budget
from acsard.calibration.error_budget.measured_errors import Line
from acsard.core.config.settings import Config, McuConfig, OdometryConfig
from tests.unit.calibration.error_budget import drives
from tests.unit.calibration.error_budget.drives import ReportedDrive

CONFIG = Config()

Make = Callable[[int, float], ReportedDrive]

CASES: dict[str, tuple[Cause, Make]] = {
    "an adapter that holds lines for 16 ms": ("time", partial(drives.late, how="batches")),
    "stalls of the host": ("time", partial(drives.late, how="stalls")),
    "a busy host": ("time", partial(drives.late, how="jitter")),
    "two decimals": ("quantization", drives.rounded),
    "40 counts a turn": ("quantization", partial(drives.rounded, counts=40)),
    "400 counts a turn": ("quantization", partial(drives.rounded, counts=400)),
    "4000 counts a turn": ("quantization", partial(drives.rounded, counts=4000)),
    "a line of ten lost": ("gaps", partial(drives.lost, share=0.1, longest=1)),
    "up to five lines lost": ("gaps", partial(drives.lost, share=0.1, longest=5)),
    "bursts lost in which the pose stands": (
        "gaps",
        partial(drives.lost, share=0.02, longest=40, stands=True),
    ),
}


def share(result: Budget, cause: Cause) -> Share:
    return next(entry for entry in result.shares if entry.cause == cause)


def as_predicted(case: str, seconds: float, seeds: int) -> float:
    """Divide the final error of each drive by the error in its budget, and return the rms.

    The result is 1 if the budget predicts the errors well.
    """
    cause, make = CASES[case]
    ratios = []
    for seed in range(seeds):
        drive = make(seed, seconds)
        result = budget(DriveMessages(drive.lines, []), CONFIG, metres=drive.metres * 0.999)
        millimetres = share(result, cause).mm_per_100_m
        assert millimetres
        ratios.append(1e3 * drive.off / millimetres)
    return math.sqrt(sum(ratio**2 for ratio in ratios) / seeds)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["an adapter that holds lines for 16 ms", "two decimals",
                                  "400 counts a turn", "up to five lines lost"])  # fmt: skip
def test_the_share_of_a_cause_is_about_the_error_it_makes_on_a_short_drive(case: str) -> None:
    assert 1 / 2 < as_predicted(case, 20.0, 10) < 2


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("case", CASES)
def test_the_share_of_a_cause_is_within_half_of_the_error_it_makes_in_450_m(case: str) -> None:
    ratio = as_predicted(case, 600.0, 20)
    print(f"{case}: error / share {ratio:.2f}")
    assert 1 / 1.5 < ratio < 1.5


# robots that do not drive, causes that are not measured, and a gyro


def driven() -> ReportedDrive:
    return drives.rounded(1, 10.0)


def test_the_budget_of_a_standing_robot_has_only_shares_from_settings() -> None:
    still = [Line(n / 100, (0.0,) * 4, (1.0,) * 4, 0.0, 0.0) for n in range(300)]
    known = replace(CONFIG, odometry=OdometryConfig(wheel_separation_multiplier_std=0.02))
    result = budget(DriveMessages(still, []), known)
    assert result.still
    assert {entry.cause: entry.basis for entry in result.shares} == {
        "slip": "settings",
        "parameters": "settings",
    }
    assert share(result, "parameters").deg_per_turn == pytest.approx(0.02 * 360, rel=0.01)
    assert share(result, "parameters").mm_per_100_m == pytest.approx(0.0, abs=1e-6)
    assert result.at_rest[1] > 0.0


def test_without_lines_the_robot_counts_as_standing_still() -> None:
    assert budget(DriveMessages([], []), CONFIG).still


def test_parameters_that_were_not_measured_have_an_unknown_share_and_not_zero() -> None:
    result = share(budget(DriveMessages(driven().lines, []), CONFIG), "parameters")
    assert (result.basis, result.mm_per_100_m, result.deg_per_turn) == ("unknown", None, None)


def test_a_track_learned_by_the_gyro_is_a_measured_error() -> None:
    result = share(budget(DriveMessages(driven().lines, [], learned=1.1), CONFIG), "parameters")
    assert result.basis == "measured"
    assert result.deg_per_turn == pytest.approx(36.0, rel=0.02)


def test_the_error_of_a_learned_track_in_use_is_its_own_deviation() -> None:
    received = DriveMessages(driven().lines, [], learned=1.1, deviation=0.02, used=True)
    result = share(budget(received, CONFIG), "parameters")
    assert result.basis == "measured"
    assert result.deg_per_turn == pytest.approx(7.2, rel=0.02)


def test_the_learned_track_is_given_as_a_multiplier_like_the_configured_one() -> None:
    config = replace(CONFIG, drive=replace(CONFIG.drive, wheel_separation_multiplier=1.5))
    result = budget(DriveMessages(driven().lines, [], learned=1.1, deviation=0.02), config)
    assert result.multiplier == 1.5
    assert result.learned_std == pytest.approx(0.033)
    assert result.learned == pytest.approx(1.65)
    assert budget(DriveMessages(driven().lines, []), config).learned is None


def test_with_a_gyro_no_error_of_the_wheels_changes_the_heading() -> None:
    lines = [replace(line, yaw_variance=1e-6 * n) for n, line in enumerate(driven().lines)]
    result = budget(DriveMessages(lines, [], gyro=True), CONFIG)
    for cause in ("time", "quantization", "gaps", "slip"):
        assert share(result, cause).deg_per_turn == 0.0
    turns = result.turned / 360
    grown = math.degrees(
        math.sqrt(lines[-1].yaw_variance / turns + (CONFIG.odometry.gyro_scale_std * math.tau) ** 2)
    )
    assert share(result, "gyro").deg_per_turn == pytest.approx(grown, rel=0.05)


def with_a_gyro(lines: list[Line], before: float = 0.0) -> Share:
    """Return the gyro's share of the budget.

    The gyro has a noise of 1 µrad² in each line with motion. A scale error grows with the heading
    since the last reset of the pose, which is `before` turns at the first line.
    """
    heading, noise, made = before * math.tau, 0.0, list[Line]()
    for last, line in pairwise([lines[0], *lines]):
        heading += math.remainder(line.yaw - last.yaw, math.tau)
        noise += 1e-6 if any(line.speeds) else 0.0
        made.append(
            replace(line, yaw_variance=noise + (CONFIG.odometry.gyro_scale_std * heading) ** 2)
        )
    return share(budget(DriveMessages(made, [], gyro=True), CONFIG), "gyro")


@pytest.mark.slow
@pytest.mark.parametrize("before", [-10, 10])
def test_the_error_of_a_gyro_per_turn_does_not_depend_on_earlier_turns(before: int) -> None:
    result, fresh = (with_a_gyro(driven().lines, turns) for turns in (before, 0.0))
    assert result.deg_per_turn == pytest.approx(fresh.deg_per_turn, rel=0.02)


@pytest.mark.slow
def test_a_rest_before_the_drive_does_not_change_the_error_of_the_gyro() -> None:
    lines = driven().lines
    still = [
        replace(lines[0], at=lines[0].at - 3.0 + n / 100, speeds=(0.0,) * 4) for n in range(300)
    ]
    result, rested = with_a_gyro(lines), with_a_gyro([*still, *lines])
    assert rested.deg_per_turn == pytest.approx(result.deg_per_turn, rel=0.05)


def test_one_long_spin_does_not_separate_gyro_noise_from_its_scale_error() -> None:
    line = driven().lines[0]
    spin = [
        replace(line, at=n / 100, yaw=n / 100, positions=(0.01 * n, -0.01 * n, -0.01 * n, 0.01 * n),
                speeds=(1.0, -1.0, -1.0, 1.0))
        for n in range(3000)
    ]  # fmt: skip
    assert with_a_gyro(spin, 10.0).basis == "unknown"


def test_with_counts_the_shares_of_time_and_gaps_are_zero_and_quantization_remains() -> None:
    counted = replace(CONFIG, mcu=McuConfig(link_check="require", encoder_counts=400))
    result = budget(DriveMessages(drives.late(1, 10.0, "batches").lines, [], counted=True), counted)
    assert share(result, "time").mm_per_100_m == share(result, "gaps").mm_per_100_m == 0.0
    assert (share(result, "quantization").mm_per_100_m or 0.0) > 0.0
    assert result.counts == 400


def test_if_lines_are_missing_here_the_shares_of_time_and_gaps_are_unknown() -> None:
    result = budget(DriveMessages(driven().lines, [], complete=False), CONFIG)
    assert {share(result, cause).basis for cause in ("time", "quantization", "gaps")} == {"unknown"}


def test_a_wheel_that_contradicts_its_neighbour_is_measured_slip() -> None:
    """The front right wheel reports zeros, so the mean of its side is half of the true value."""
    lines = [
        replace(line, positions=(0.0, *line.positions[1:]), speeds=(0.0, *line.speeds[1:]))
        for line in driven().lines
    ]
    result = share(budget(DriveMessages(lines, []), CONFIG), "slip")
    assert result.basis == "measured"
    assert (result.mm_per_100_m or 0.0) > 10_000


def test_wheels_that_contradict_each_other_in_a_turn_in_place_are_measured_slip() -> None:
    lines = [
        Line(n / 100, (1.0, -1.0, -2.0, 2.0), (n / 100, -n / 100, -n / 50, n / 50), n / 200, 0.0)
        for n in range(3000)
    ]
    result = share(budget(DriveMessages(lines, []), CONFIG), "slip")
    assert result.mm_per_100_m is None
    assert result.basis == "measured"
    assert (result.deg_per_turn or 0.0) > 60.0


def test_the_largest_cause_is_chosen_among_the_requested_bases() -> None:
    result = budget(DriveMessages(driven().lines, []), CONFIG)
    quantization, slip = result.largest("measured"), result.largest("measured", "settings")
    assert quantization is not None
    assert slip is not None
    assert (quantization.cause, slip.cause) == ("quantization", "slip")
    assert result.largest() is None
    millimetres, _ = result.total()
    assert millimetres is not None
    assert millimetres >= max(entry.mm_per_100_m or 0.0 for entry in result.shares)


@pytest.mark.parametrize("back", [1.0, 0.9])
def test_a_robot_that_only_moved_to_and_fro_within_a_step_has_no_measured_errors(
    back: float,
) -> None:
    """The budget divides a long measurement into long steps, in which the motion cancels."""
    radius, lines, angle = CONFIG.drive.wheel_radius, [], 0.0
    for number in range(30_000):
        ahead, behind = 1000 <= number < 1110, 1110 <= number < 1220
        speed = round(0.1 * (ahead - back * behind) / radius, 2)
        angle += 0.01 * speed
        lines.append(Line(0.01 * number, (speed,) * 4, (angle,) * 4, 0.0, 0.0))
    result = budget(DriveMessages(lines, [line.at - 0.001 for line in lines]), CONFIG)
    assert result.still
