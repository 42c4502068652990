"""A recording becomes a table that calibration reads without changes."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from acsard.calibration.log_table import read
from acsard.core.config.settings import Config
from acsard.core.robot import Robot
from acsard.core.values import GyroSample, Instant
from acsard.recording.export import (
    CSV_HEADER,
    MEASURED_CSV_HEADER,
    csv_rows,
    gyro_columns,
    measured_csv_rows,
    wheel_columns,
)
from acsard.recording.replay import replay_step
from tests.scenarios.taped import Tape
from tests.scenarios.world import START, World

GYRO = replace(Config(), odometry=replace(Config().odometry, gyro=True))


@pytest.fixture(scope="module")
def tape() -> Tape:
    tape = Tape()
    world = World(GYRO, recorder=tape)
    world.drive(0.5, 0.4, 1.0)
    return tape


def test_the_table_has_a_row_for_each_feedback_line_and_each_gyro_sample(tape: Tape) -> None:
    robot = Robot(GYRO)
    lines: list[str] = []
    for step in tape.steps():
        lines += csv_rows(step, replay_step(robot, step))
    estimates = [e for t in tape.taken for e in t.outputs.estimates]
    reports = [one for t in tape.taken for one in t.inputs.gyro]
    cells = [line.split(",") for line in lines]
    assert {len(row) for row in cells} == {len(CSV_HEADER.split(","))}
    assert len(estimates) == sum(row[1] != "" for row in cells) > 100
    assert len(reports) == sum(row[5] != "" for row in cells) > 100
    assert ["driving", "up", "app"] in [row[-3:] for row in cells]


def test_calibration_reads_the_same_from_the_whole_table_and_from_the_measured_columns(
    tape: Tape,
) -> None:
    robot, twin = Robot(GYRO), Robot(GYRO)
    whole, part = [CSV_HEADER], [MEASURED_CSV_HEADER]
    for step in tape.steps():
        whole += csv_rows(step, replay_step(robot, step))
        part += measured_csv_rows(step, replay_step(twin, step))
    tables = [read("\n".join(lines).encode()) for lines in (whole, part)]
    assert list(tables[0].columns) == ["t", "fr", "fl", "rl", "rr", "yaw_rate"]
    for name, values in tables[0].columns.items():
        np.testing.assert_array_equal(values, tables[1].columns[name])
    speeds = [e.speeds.front_right for t in tape.taken for e in t.outputs.estimates]
    fr = tables[0].columns["fr"]
    np.testing.assert_allclose(fr[~np.isnan(fr)], speeds, rtol=1e-5)


def test_the_times_in_the_table_are_those_of_the_samples(tape: Tape) -> None:
    estimate = tape.taken[-1].outputs.estimates or tape.taken[-2].outputs.estimates
    wall_ns = estimate[0].at.wall_ns
    assert wheel_columns(estimate[0]).startswith(f"{wall_ns // 10**9}.{wall_ns % 10**9 // 1000:06}")
    now = Instant(START.mono_ns + 50, START.wall_ns + 50)
    arrived = GyroSample(START.mono_ns + 2_000_050, None, 0.25)
    assert gyro_columns(arrived, now) == "1800000000.002000,,,,,0.25"
    assert gyro_columns(replace(arrived, stamp_ns=1_500_000), now) == "0.001500,,,,,0.25"
