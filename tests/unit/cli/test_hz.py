"""Tests of rate and jitter of arrival times against figures worked out by hand."""

from __future__ import annotations

import pytest

from acsard.cli.hz import rate


@pytest.mark.parametrize("times", [[], [3.0]])
def test_fewer_than_two_messages_have_no_rate(times: list[float]) -> None:
    assert rate(times) == {"count": len(times), "hz": 0.0}


def test_the_figures_of_three_messages_equal_those_computed_by_hand() -> None:
    # The gaps are 10 and 20 ms: mean 15, deviation 5, and the 99th percentile lies 99 % of the way
    # up.
    assert rate([1.0, 1.01, 1.03]) == {
        "count": 3,
        "hz": 66.67,
        "gap_min_ms": 10.0,
        "gap_p50_ms": 15.0,
        "gap_p99_ms": 19.9,
        "gap_max_ms": 20.0,
        "gap_std_ms": 5.0,
    }


def test_an_even_stream_has_even_gaps() -> None:
    figures = rate([100.0 + n / 100 for n in range(1000)])
    assert figures["count"] == 1000
    assert figures["hz"] == 100.0
    assert figures["gap_min_ms"] == figures["gap_p50_ms"] == figures["gap_max_ms"] == 10.0
    assert figures["gap_std_ms"] == 0.0


def test_one_hole_shows_in_the_largest_gap_and_hardly_in_the_median() -> None:
    figures = rate([n / 100 + (0.5 if n >= 500 else 0.0) for n in range(1000)])
    assert figures["gap_max_ms"] == 510.0
    assert figures["gap_p50_ms"] == figures["gap_p99_ms"] == 10.0
    assert figures["hz"] == pytest.approx(999 / 10.49, abs=0.01)


def test_messages_of_one_instant_have_no_rate() -> None:
    assert rate([1.0, 1.0]) == {"count": 2, "hz": 0.0}
