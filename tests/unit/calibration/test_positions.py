"""Tests of paths, of their alignment with positions, and of the fit's start values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acsard.calibration import positions
from acsard.calibration.fit import PARAMETER_COUNT, Base, Parameter
from acsard.calibration.positions import StartingPoint, search, segments
from acsard.calibration.runs import Block, blocks
from tests.unit.calibration.cut import BASE, ideal, log_of, table, usual
from tests.unit.calibration.robots import Drive, Floats, Plan, Robot, drive

TRUE = np.array([0.998, 1.002, 1 / 1.6, 0.0, 0.0, 0.0, 0.0])
OFF = np.array([1.05, 0.95, 0.7, 0.0, 0.03, 0.1, -0.05, 0.0, 0.0])


def of(drive: Drive):  # type: ignore[no-untyped-def]
    runs = log_of(table(drive, gyro=False)).runs
    parts = [Block(0, float(b), float(b) + 8) for b in np.arange(3, 75, 8)]
    return runs[0], positions.segments(runs, parts)


def test_the_true_parameters_leave_no_residual() -> None:
    run, segments = of(ideal())
    paths = [positions.path(positions.wheel_steps(run), BASE, TRUE)]
    assert positions.spread(segments, paths) < 0.001


def test_a_path_without_derivatives_is_the_same_path() -> None:
    run, _ = of(ideal())
    steps = positions.wheel_steps(run)
    assert np.allclose(positions.place(steps, BASE, TRUE), positions.path(steps, BASE, TRUE).place)


def test_derivatives_are_those_of_the_position_of_the_sensor() -> None:
    run, _ = of(ideal())
    steps, t = positions.wheel_steps(run), np.arange(5.0, 20.0, 0.7)
    place, derivatives = positions.path(steps, BASE, OFF).at(t)
    for index in range(PARAMETER_COUNT):
        more = OFF.copy()
        more[index] += 1e-5
        moved, _ = positions.path(steps, BASE, more).at(t)
        size = np.abs(derivatives[:, index]).max()
        assert np.allclose((moved - place) / 1e-5, derivatives[:, index], atol=0.01 * size)


def test_a_jump_of_the_source_costs_no_more_than_its_block_s_alignment() -> None:
    drive = ideal()
    moved = drive.place + np.where(drive.place_t > 40, 30 - 20j, 0)
    run, segments = of(replace(drive, place=moved))
    assert len(positions.jumps(run)) == 1
    paths = [positions.path(positions.wheel_steps(run), BASE, TRUE)]
    assert positions.spread(segments, paths) < 0.001


def test_outliers_are_removed() -> None:
    run, segments = of(usual())
    assert len(positions.jumps(run)) >= 4
    paths = [positions.path(positions.wheel_steps(run), BASE, TRUE)]
    assert positions.spread(segments, paths) < 0.05


def test_one_step_by_the_evidence_reaches_the_true_parameters() -> None:
    run, segments = of(ideal())
    near = TRUE + np.array([0.002, -0.001, 0.002, 0, 0, 0, 0])
    made = positions.evidence(segments, [positions.path(positions.wheel_steps(run), BASE, near)], 9)
    step = np.linalg.lstsq(made.normal.sum(axis=0)[:3, :3], made.score.sum(axis=0)[:3], rcond=None)
    assert near[:3] + step[0] == pytest.approx(TRUE[:3], abs=3e-4)


@pytest.mark.parametrize(("count", "used"), [(79, 79), (80, 80), (81, 41), (159, 80), (160, 80)])
def test_the_search_uses_at_most_80_evenly_spaced_positions_of_a_segment(
    count: int, used: int
) -> None:
    t = np.arange(float(count))
    (segment,) = positions._furthest([positions.Segment(0, 0, t, t.astype(np.complex128))], 1)
    assert len(segment.t) == used
    assert np.ptp(np.diff(segment.t)) == 0.0
    assert np.array_equal(segment.place.real, segment.t)


def begun(trip: Drive, base: Base = BASE, sides: Floats | None = None) -> StartingPoint:
    runs = log_of(table(trip, gyro=False)).runs
    return search(segments(runs, blocks(runs, 8.0)), runs, base, sides)


@pytest.mark.variations(3)
@pytest.mark.parametrize("separation", [0.15, 0.3, 0.9])
@pytest.mark.parametrize("radius", [0.02, 0.05, 0.2])
def test_the_search_finds_a_starting_point_near_the_truth(separation: float, radius: float) -> None:
    start = begun(usual(), Base(radius, separation, 1.0, 1.0, 1.0))
    assert start.unexplained < 0.05
    assert start.parameters[Parameter.LEFT] == pytest.approx(0.05 / radius, rel=0.1)
    assert start.parameters[Parameter.INVERSE_TRACK] == pytest.approx(separation / 0.5, rel=0.15)


@pytest.mark.slow
def test_a_reversed_side_and_a_mirrored_path_show_in_the_signs() -> None:
    trip = usual()
    left, mirrored = replace(trip, left=-trip.left), replace(trip, place=trip.place.conj())
    values = begun(left).parameters
    signs = np.sign(values[[Parameter.LEFT, Parameter.RIGHT]] * values[Parameter.INVERSE_TRACK])
    assert signs.tolist() == [-1.0, 1.0]
    assert begun(mirrored).parameters[Parameter.INVERSE_TRACK] < 0


def test_the_delay_of_late_positions_is_found() -> None:
    trip = usual()
    late = replace(trip, place_t=trip.place_t + 0.9)
    assert begun(late).parameters[Parameter.DELAY] == pytest.approx(0.9, abs=0.15)


def squares(chi: float) -> Plan:
    """Return a plan of squares to both sides.

    The turns in place are 90 deg for a robot with this track ratio.
    """
    side = [(5, 0.4, 0), (0.5, 0, 0), (4, 0, np.pi / 2 * chi / 4), (0.5, 0, 0)]
    return [(3, 0, 0), *side * 8, *[(seconds, v, -w) for seconds, v, w in side * 8]]


@pytest.mark.slow
@pytest.mark.parametrize("chi", [1.3, 1.6, 2.0])
@pytest.mark.parametrize("lever", [0j, 0.1 + 0.1j])
def test_an_ambiguous_turn_in_place_is_taken_for_the_likeliest_angle(
    chi: float, lever: complex
) -> None:
    """Positions alone cannot distinguish turns of 90 deg left, 270 deg right and 450 deg left."""
    robot = Robot(chi=chi, rate=0.0, lever=lever, slip=0.02)
    trip = drive(robot, squares(chi))
    assert begun(trip).parameters[Parameter.INVERSE_TRACK] == pytest.approx(1 / chi, rel=0.05)
    mirrored = replace(trip, place=trip.place.conj())
    sides = np.array([1.0, 1.0]) / chi
    assert begun(mirrored, sides=-sides).parameters[Parameter.INVERSE_TRACK] == pytest.approx(
        -1 / chi, rel=0.05
    )
