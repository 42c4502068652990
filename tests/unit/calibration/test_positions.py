"""Tests of paths, their derivatives, and their alignment with positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acsard.calibration import positions
from acsard.calibration.fit import COUNT
from acsard.calibration.runs import Block
from tests.unit.calibration.cut import BASE, ideal, log_of, table, usual
from tests.unit.calibration.robots import Drive

TRUE = np.array([0.998, 1.002, 1 / 1.6, 0.0, 0.0, 0.0, 0.0])
OFF = np.array([1.05, 0.95, 0.7, 0.0, 0.03, 0.1, -0.05, 0.0, 0.0])


def of(drive: Drive):  # type: ignore[no-untyped-def]
    runs = log_of(table(drive, gyro=False)).runs
    parts = [Block(0, float(b), float(b) + 8) for b in np.arange(3, 75, 8)]
    return runs[0], positions.segments(runs, parts)


def test_the_true_parameters_leave_nothing() -> None:
    run, segments = of(ideal())
    paths = [positions.path(positions.wheel_steps(run), BASE, TRUE)]
    assert positions.spread(segments, paths, TRUE) < 0.001


def test_a_path_without_slopes_is_the_same_path() -> None:
    run, _ = of(ideal())
    steps = positions.wheel_steps(run)
    assert np.allclose(positions.place(steps, BASE, TRUE), positions.path(steps, BASE, TRUE).place)


def test_slopes_are_those_of_where_the_sensor_is() -> None:
    run, _ = of(ideal())
    steps, t = positions.wheel_steps(run), np.arange(5.0, 20.0, 0.7)
    place, derivatives = positions.path(steps, BASE, OFF).at(t, OFF)
    for index in range(COUNT):
        more = OFF.copy()
        more[index] += 1e-5
        moved, _ = positions.path(steps, BASE, more).at(t, more)
        size = np.abs(derivatives[:, index]).max()
        assert np.allclose((moved - place) / 1e-5, derivatives[:, index], atol=0.01 * size)


def test_a_jump_of_the_source_costs_no_more_than_its_block_s_alignment() -> None:
    drive = ideal()
    moved = drive.place + np.where(drive.place_t > 40, 30 - 20j, 0)
    run, segments = of(replace(drive, place=moved))
    assert len(positions.jumps(run)) == 1
    paths = [positions.path(positions.wheel_steps(run), BASE, TRUE)]
    assert positions.spread(segments, paths, TRUE) < 0.001


def test_outliers_are_taken_out() -> None:
    run, segments = of(usual())
    assert len(positions.jumps(run)) >= 4
    paths = [positions.path(positions.wheel_steps(run), BASE, TRUE)]
    assert positions.spread(segments, paths, TRUE) < 0.05


def test_evidence_leads_to_the_truth() -> None:
    run, segments = of(ideal())
    near = TRUE + np.array([0.002, -0.001, 0.002, 0, 0, 0, 0])
    made = positions.evidence(
        segments, [positions.path(positions.wheel_steps(run), BASE, near)], near, 9
    )
    step = np.linalg.lstsq(made.normal.sum(axis=0)[:3, :3], made.score.sum(axis=0)[:3], rcond=None)
    assert near[:3] + step[0] == pytest.approx(TRUE[:3], abs=3e-4)
