"""Tests of the simulator's noise, which is the same in every run."""

from __future__ import annotations

import itertools
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.simulator.noise import gauss, uniform

seed = st.integers(0, 2**64)
MANY = range(20_000)


@given(seed, st.integers(0, 2**40))
def test_the_nth_number_of_a_seed_is_always_the_same(one: int, n: int) -> None:
    assert uniform(one, n) == uniform(one, n)
    assert 0.0 <= uniform(one, n) < 1.0


@given(st.integers(0, 2**32))
def test_neighbouring_seeds_share_no_numbers(one: int) -> None:
    assert not {uniform(one, n) for n in range(50)} & {uniform(one + 1, n) for n in range(50)}


def test_uniform_numbers_fill_their_range_evenly() -> None:
    tenths = [0] * 10
    for n in MANY:
        tenths[int(10 * uniform(7, n))] += 1
    assert tenths == pytest.approx([2000] * 10, abs=5 * 2000**0.5)


def test_normal_numbers_have_mean_0_and_deviation_1() -> None:
    drawn = [gauss(7, n) for n in MANY]
    assert statistics.fmean(drawn) == pytest.approx(0.0, abs=5 / 20_000**0.5)
    assert statistics.pstdev(drawn) == pytest.approx(1.0, abs=0.03)
    assert sum(abs(number) > 2 for number in drawn) / 20_000 == pytest.approx(0.0455, abs=0.006)


def test_consecutive_normal_numbers_are_uncorrelated() -> None:
    drawn = [gauss(3, n) for n in MANY]
    products = [a * b for a, b in itertools.pairwise(drawn)]
    assert statistics.fmean(products) == pytest.approx(0.0, abs=5 / 20_000**0.5)
