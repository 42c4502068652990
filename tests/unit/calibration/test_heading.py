"""Tests of the gyro's bias and delay, of the fit's rows made with them, and of their evidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acsard.calibration import heading
from acsard.calibration.fit import PARAMETER_COUNT, Parameter, huber
from acsard.calibration.heading import of_gyro, of_yaw, rows
from acsard.calibration.log_table import LogError
from acsard.calibration.runs import blocks
from tests.unit.calibration.cut import BASE, ideal, log_of, ready, table, usual
from tests.unit.calibration.robots import GUIDED, Drive, wander


def headings_of(drive: Drive):  # type: ignore[no-untyped-def]
    runs = log_of(table(drive, places=False)).runs
    return runs, of_gyro(runs)


def test_the_bias_is_found_at_rest() -> None:
    assert headings_of(usual())[1].bias == pytest.approx(0.01, abs=0.001)


def test_the_bias_of_a_coarsely_rounded_gyro_is_found_between_its_steps() -> None:
    drive = usual()
    coarse = replace(drive, gyro=np.round(drive.gyro - 0.006, 2))
    assert headings_of(coarse)[1].bias == pytest.approx(0.004, abs=0.001)


def test_a_slow_gyro_with_a_spike_in_a_short_rest_has_a_bias() -> None:
    drive = usual(plan=[(3, 0, 0), (4, 0.3, 0.0), (4, 0.0, 1.0), (1.8, 0, 0), (4, 0.0, -1.0)])
    every = round(0.25 / float(np.median(np.diff(drive.gyro_t))))
    slow = replace(drive, gyro=drive.gyro[::every].copy(), gyro_t=drive.gyro_t[::every])
    in_rest = int(np.searchsorted(slow.gyro_t, 12.0))
    slow.gyro[in_rest] += 0.02
    headings = headings_of(slow)[1]
    assert headings.bias == pytest.approx(0.01, abs=0.01)
    assert 0.0 < headings.bias_std < 0.1


@pytest.mark.parametrize(("noise", "walk"), [(0.05, 0.0), (0.003, 0.0003)])
def test_the_standard_deviation_of_the_bias_covers_the_truth(noise: float, walk: float) -> None:
    z = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        drive = usual(seed, plan=wander(rng, 120.0))
        step = np.median(np.diff(drive.gyro_t))
        walked = np.cumsum(rng.normal(0, walk * np.sqrt(step), len(drive.gyro_t)))
        noisy = drive.gyro + walked + rng.normal(0, noise, len(walked))
        _, headings = headings_of(replace(drive, gyro=noisy))
        heading = headings.per_run[0]
        turned = np.interp(heading.t - 0.02, drive.t, drive.yaw)
        off = (heading.angle - turned)[[0, -1]] @ [-1, 1] / np.ptp(heading.t)
        z.append(off / headings.bias_std)
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_without_a_rest_the_bias_is_left_to_the_fit() -> None:
    moving = [part for part in GUIDED if part[1] or part[2]]
    assert headings_of(usual(plan=moving))[1].bias_unknown


@pytest.mark.parametrize("late", [-0.7, 0.0, 0.05, 1.2])
def test_the_time_offset_is_found(late: float) -> None:
    drive = usual()
    shifted = replace(drive, gyro_t=drive.gyro_t + late)
    assert headings_of(shifted)[1].delay == pytest.approx(late + 0.02, abs=0.005)


def test_a_reversed_side_does_not_hide_the_time_offset() -> None:
    drive = usual()
    assert headings_of(replace(drive, left=-drive.left))[1].delay == pytest.approx(0.02, abs=0.02)


def test_a_gyro_with_a_constant_value_is_refused() -> None:
    drive = usual()
    with pytest.raises(LogError, match="same value in every row"):
        headings_of(replace(drive, gyro=drive.gyro * 0))


def test_rows_add_up_to_the_turned_angle() -> None:
    drive = usual()
    runs, headings = headings_of(drive)
    result = rows(headings, runs, blocks(runs, 4.0))
    assert np.abs(result.turned).sum() == pytest.approx(np.abs(np.diff(drive.yaw)).sum(), rel=0.03)


def test_no_row_spans_a_gap_of_the_gyro() -> None:
    drive = usual()
    mask = (drive.gyro_t < 30) | (drive.gyro_t > 40)
    runs, headings = headings_of(replace(drive, gyro_t=drive.gyro_t[mask], gyro=drive.gyro[mask]))
    result = rows(headings, runs, blocks(runs, 4.0))
    assert 61 <= result.seconds.sum() <= 74


@pytest.mark.parametrize("wrapped", [True, False])
def test_degrees_are_distinguished_from_radians(wrapped: bool) -> None:
    drive = usual()
    yaw = np.degrees(drive.yaw)
    yaw = (yaw + 180) % 360 - 180 if wrapped else yaw
    lines = [f"{t:.3f},{a},{b},{w:.3f}"
             for t, a, b, w in zip(drive.t, drive.left, drive.right, yaw, strict=True)]  # fmt: skip
    runs = log_of("t,left,right,yaw\n" + "\n".join(lines)).runs
    with pytest.raises(LogError, match="degrees"):
        of_yaw(runs, 0.05 / 0.3)


AT = np.array([0.9, 1.1, 0.6, 0.05, *[0.0] * (PARAMETER_COUNT - 4)])


def test_least_squares_find_both_sides_whatever_their_sign() -> None:
    rows = ready(table(ideal(), places=False)).rows
    left, right = heading.side_factors(rows, BASE)
    assert left == pytest.approx(0.998 / 1.6, rel=1e-3)
    assert right == pytest.approx(1.002 / 1.6, rel=1e-3)
    assert np.allclose(
        heading.by_sides(rows, BASE, np.array([left, right])), rows.turned, atol=0.01
    )


def test_the_score_has_the_derivatives_of_the_turn_of_the_wheels() -> None:
    rows = ready(table(ideal(), places=False)).rows
    step = 1e-6
    score = heading.evidence(rows, BASE, AT, len(rows.turned)).score.sum(axis=0)
    for index in range(4):
        more = AT.copy()
        more[index] += step
        slope = (heading.turned(rows, BASE, more) - heading.turned(rows, BASE, AT)) / step
        residual = rows.turned - heading.turned(rows, BASE, AT)
        usual = np.hypot(
            heading.NOISE * rows.seconds, heading.SHARE * heading.turned(rows, BASE, AT)
        )
        weight = huber(residual / usual, 1.0)
        # The other parameters also change the rate term, but only to second order.
        assert score[index] == pytest.approx(float(slope @ (weight * residual)), rel=0.15)
    assert not score[[Parameter.DELAY, Parameter.SENSOR_X, Parameter.SENSOR_Y]].any()
