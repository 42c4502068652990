"""Tests of the difference between the front and the rear wheel of one side.

Its causes are slip, encoder counts, unequal tyres, and a slower motor.
"""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.motion.wheel_residual import MAX_LASTING_DIFFERENCE, TIME_CONSTANT_S, Residual

DT = 0.01
KEEP = TIME_CONSTANT_S / (TIME_CONSTANT_S + DT)
FINE = math.tau / 3200


def rolled(
    residual: Residual, front: float, rear: float, seconds: float, count: float = FINE
) -> list[bool]:
    """Feed lines with these speeds, rad/s. Return for each whether front and rear wheel agree."""
    lines = round(seconds / DT)
    return [residual.add(front * DT, rear * DT, KEEP, DT, count) for _ in range(lines)]


@given(st.floats(-40.0, 40.0))
def test_two_wheels_that_turn_alike_agree(speed: float) -> None:
    residual = Residual()
    assert all(rolled(residual, speed, speed, 1.0))
    assert residual.ratio == 0.0


@pytest.mark.parametrize("speed", [8.0, -15.0])
@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_tenth_more_on_one_wheel_is_a_contradiction_within_a_fifth_of_a_second(
    speed: float, share: float
) -> None:
    residual = Residual()
    rolled(residual, speed, speed, 2.0)
    flags = rolled(residual, speed * share, speed, 0.2)
    assert flags[0]
    assert not flags[-1]
    assert residual.slips


def test_wheels_of_unequal_size_agree_once_their_ratio_is_learned() -> None:
    residual = Residual()
    rolled(residual, 10.3, 10.0, 30.0)
    assert residual.ratio == pytest.approx(0.3 / 10.15, rel=0.02)
    assert all(rolled(residual, -10.3, -10.0, 1.0))


def test_the_learned_ratio_stays_within_the_limit_for_unequal_tyres() -> None:
    residual = Residual()
    rolled(residual, 14.0, 10.0, 600.0)
    assert residual.ratio == pytest.approx(MAX_LASTING_DIFFERENCE)
    assert not residual.add(0.14, 0.10, KEEP, DT, FINE)


@pytest.mark.parametrize("front", [True, False])
def test_the_wheel_that_replaces_another_one_gives_the_speed_of_that_wheel(front: bool) -> None:
    residual = Residual()
    rolled(residual, 10.4, 10.0, 60.0)
    speed, missing = (10.0, 10.4) if front else (10.4, 10.0)
    assert speed * residual.stand_in(front) == pytest.approx(missing, rel=2e-3)


@pytest.mark.parametrize("counts", [16, 96, 400])
@given(phase=st.floats(0.0, 1.0), speed=st.floats(0.5, 30.0))
def test_wheels_that_differ_by_a_part_of_a_count_agree(
    counts: int, phase: float, speed: float
) -> None:
    residual, count = Residual(), math.tau / counts
    angles = [(math.floor(speed * DT * n / count), math.floor(speed * DT * n / count + phase))
              for n in range(301)]  # fmt: skip
    for (front, rear), (after, behind) in pairwise(angles):
        assert residual.add((after - front) * count, (behind - rear) * count, KEEP, DT, count)


def test_a_motor_that_follows_later_than_the_other_is_no_slip() -> None:
    residual, speeds = Residual(), [0.0, 0.0]
    for n in range(600):
        goal = min(15.0, 0.2 * n) if n < 300 else max(0.0, 15.0 - 0.2 * (n - 300))
        for i, lag in enumerate((0.05, 0.065)):
            speeds[i] += (goal - speeds[i]) * DT / lag
        assert residual.add(speeds[0] * DT, speeds[1] * DT, KEEP, DT, FINE) or not residual.slips
