"""Percentiles in fixed memory are exact to one bucket.

They are never below the truth and never above the maximum.
"""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.runtime.histogram import DECADES, PER_DECADE, Histogram
from acsard.values import Spread

BUCKET = 10 ** (1 / PER_DECADE)
"""Upper end of a bucket divided by its lower end: 1.122."""


def spread_of(values: list[float]) -> Spread:
    histogram = Histogram()
    for value in values:
        histogram.add(value)
    return histogram.spread()


def order_statistic(values: list[float], share: float) -> float:
    """Return the smallest value that at least `share` of all values do not exceed."""
    return sorted(values)[max(0, math.ceil(share * len(values)) - 1)]


def test_nothing_measured_is_all_zeros() -> None:
    assert Histogram().spread() == Spread(0, 0.0, 0.0, 0.0)


@given(st.lists(st.floats(1.0, 10.0**DECADES), min_size=1, max_size=300))
def test_a_percentile_is_at_most_one_bucket_above_the_truth(values: list[float]) -> None:
    spread = spread_of(values)
    for share, shown in ((0.50, spread.p50), (0.99, spread.p99)):
        truth = order_statistic(values, share)
        assert truth * (1 - 1e-9) <= shown <= truth * BUCKET * (1 + 1e-9)


@given(st.lists(st.floats(-1e3, 1e12), min_size=1, max_size=100))
def test_count_and_maximum_are_exact_and_the_percentiles_in_order(values: list[float]) -> None:
    spread = spread_of(values)
    assert spread.count == len(values)
    assert spread.max == max(0.0, *values)
    assert 0.0 <= spread.p50 <= spread.p99 <= spread.max


def test_one_outlier_in_two_hundred_shows_in_the_maximum_only() -> None:
    spread = spread_of([10.0] * 199 + [5000.0])
    assert spread.p50 == pytest.approx(10.0, rel=0.13)
    assert spread.p99 == pytest.approx(10.0, rel=0.13)
    assert spread.max == 5000.0


def test_two_outliers_in_a_hundred_show_in_the_99th_percentile() -> None:
    spread = spread_of([10.0] * 98 + [5000.0] * 2)
    assert spread.p50 == pytest.approx(10.0, rel=0.13)
    assert spread.p99 == pytest.approx(5000.0, rel=0.13)


def test_what_lies_beyond_the_decades_falls_into_the_end_buckets() -> None:
    assert spread_of([0.001]).p50 == 0.001
    assert spread_of([3e9]).p50 == pytest.approx(10.0**DECADES)
    assert spread_of([3e9]).max == 3e9
