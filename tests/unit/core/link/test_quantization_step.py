"""Speeds that are whole counts are multiples of a quantization step, and other speeds are not."""

from __future__ import annotations

import math
import random
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.link.quantization_step import FINEST, ROUNDING, Quantization, Search, on

PERIOD = 0.01


def found(speeds: list[float]) -> Quantization | None:
    """Return the result of the search."""
    return sliced(speeds)[0]


def sliced(speeds: list[float]) -> tuple[Quantization | None, int]:
    """Return the result of the search and the number of its slices."""
    searching, slices = Search(Counter(speeds)), 1
    while not searching.go_on():
        slices += 1
    return searching.found, slices


def told(quantum: float, wholes: list[int]) -> list[float]:
    """Return speeds of these whole counts per period, in two decimals."""
    return [round(whole * quantum, 2) for whole in wholes]


def quantum_of(counts: int) -> float:
    return math.tau / counts / PERIOD


@given(
    counts=st.integers(16, 6000),
    seed=st.integers(0, 1000),
    fastest=st.floats(15.0, 60.0),
)
def test_whole_counts_are_found_and_how_many_a_turn_has(
    counts: int, seed: int, fastest: float
) -> None:
    quantum, dice = quantum_of(counts), random.Random(seed)
    wholes = [dice.randint(1, max(1, int(fastest / quantum))) for _ in range(200)]
    lattice = found(told(quantum, [1, 2, 3, *wholes]))
    assert lattice is not None
    assert abs(lattice.quantum - quantum) < 6 * lattice.deviation
    assert lattice.counts(PERIOD) in (counts, 0 if counts > 2000 else counts)


@pytest.mark.parametrize("counts", [16, 20, 40])
def test_one_count_to_and_fro_is_enough_where_a_count_is_much(counts: int) -> None:
    lattice = found(told(quantum_of(counts), [1] * 100))
    assert lattice is not None
    assert lattice.counts(PERIOD) == counts


def test_speeds_of_a_fine_encoder_that_hardly_change_prove_nothing() -> None:
    fine = quantum_of(3200)
    assert found(told(fine, [51, 50] * 50)) is None


@given(seed=st.integers(0, 10_000), fastest=st.floats(1.0, 40.0))
def test_speeds_that_lie_anywhere_have_none(seed: int, fastest: float) -> None:
    dice = random.Random(seed)
    assert found([round(dice.uniform(0.03, fastest), 2) for _ in range(100)]) is None


def test_a_few_damaged_lines_hide_none_and_more_do() -> None:
    true = told(quantum_of(400), [1 + i % 14 for i in range(1000)])
    assert found([*true, 7.77, 33.33, 99.99, 1.11]) is not None
    assert found([*true, *[0.8 + 0.1 * i for i in range(50)]]) is None


def test_none_is_finer_than_chance_would_have_it() -> None:
    assert found(told(FINEST * 0.95, list(range(1, 120)))) is None


def test_it_is_searched_in_slices_and_never_for_ever() -> None:
    dice = random.Random(1)
    lattice, slices = sliced([round(dice.uniform(0.03, 99.0), 2) for _ in range(256)])
    assert lattice is None
    assert 100 < slices < 5000


def test_a_period_by_which_counts_are_not_whole_is_not_the_firmwares() -> None:
    lattice = Quantization(quantum_of(400), 1e-6)
    assert lattice.counts(PERIOD) == 400
    assert lattice.counts(PERIOD * 1.001) == 0
    assert lattice.counts(PERIOD * 2) == 200


def test_a_lattice_known_too_badly_for_a_whole_number_has_none() -> None:
    assert Quantization(quantum_of(4000), 2e-6).counts(PERIOD) == 4000
    assert Quantization(quantum_of(4000), 4e-5).counts(PERIOD) == 0


@given(whole=st.integers(-200, 200), counts=st.integers(16, 4000))
def test_what_rounding_made_of_a_multiple_is_on_and_what_is_more_off_is_not(
    whole: int, counts: int
) -> None:
    quantum = quantum_of(counts)
    assert on(round(whole * quantum, 2), quantum)
    assert not on(whole * quantum + 1.1 * ROUNDING, quantum)
