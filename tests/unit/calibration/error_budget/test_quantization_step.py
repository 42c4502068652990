"""Speeds that are whole counts are multiples of a quantization step, and other speeds are not."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.calibration.error_budget.quantization_step import MIN_STEP, quantization_step

PERIOD = 0.01


def step_of(speeds: list[float]) -> float:
    return quantization_step(np.unique(speeds))


def reported(quantum: float, wholes: list[int]) -> list[float]:
    """Return the speeds for these whole counts per period, rounded to two decimals."""
    return [round(whole * quantum, 2) for whole in wholes]


def quantum_of(counts: int) -> float:
    return math.tau / counts / PERIOD


@given(counts=st.integers(50, 6000), seed=st.integers(0, 1000), fastest=st.floats(15.0, 60.0))
def test_the_step_of_whole_counts_is_found(counts: int, seed: int, fastest: float) -> None:
    quantum, dice = quantum_of(counts), random.Random(seed)
    wholes = [dice.randint(1, max(1, int(fastest / quantum))) for _ in range(200)]
    assert step_of(reported(quantum, [1, 2, 3, 4, *wholes])) == pytest.approx(quantum, abs=0.003)


@given(seed=st.integers(0, 10_000), fastest=st.floats(1.0, 40.0))
def test_random_speeds_have_no_quantization_step(seed: int, fastest: float) -> None:
    dice = random.Random(seed)
    assert step_of([round(dice.uniform(0.03, fastest), 2) for _ in range(100)]) == 0.0


def test_a_few_damaged_lines_do_not_hide_the_step_but_many_do() -> None:
    true = reported(quantum_of(3200), list(range(1, 400)))
    assert step_of([*true, 0.05]) == pytest.approx(quantum_of(3200), abs=1e-4)
    assert step_of([*true, *[0.83 + 0.1 * i for i in range(50)]]) == 0.0


def test_a_step_that_chance_could_explain_is_not_found() -> None:
    assert step_of(reported(MIN_STEP * 0.95, list(range(1, 120)))) == 0.0
