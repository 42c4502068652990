"""Tests of the lateness of a message, measured against the smallest delay so far.

The clocks of both ends are not synchronized.
"""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.link.minimum_delay import MinimumDelay


def test_the_first_event_has_no_lateness() -> None:
    assert MinimumDelay(0.0).late == 0.0


def test_lateness_is_the_difference_between_the_two_clocks_intervals() -> None:
    promptest = MinimumDelay(0.0)
    assert promptest.add(ours=30, theirs=10) == 20
    assert promptest.late == 20
    assert promptest.add(ours=10, theirs=15) == 15
    assert promptest.late == 15


def test_an_earlier_event_becomes_the_new_minimum() -> None:
    promptest = MinimumDelay(0.0)
    assert promptest.add(10, 13) == -3
    assert promptest.late == 0.0
    assert promptest.add(10, 10) == 0.0
    assert promptest.add(13, 10) == 3


def test_the_drift_allowance_grows_with_time_and_makes_no_lateness_negative() -> None:
    promptest = MinimumDelay(0.01)
    assert promptest.add(200, 100) == 100  # the drift allowance comes afterwards
    assert promptest.late == 98
    promptest.add(1000, 1000)
    assert promptest.late == 88
    promptest.add(10_000, 10_000)
    assert promptest.late == 0.0


def test_a_measurement_that_is_not_believed_does_not_change_the_minimum() -> None:
    promptest = MinimumDelay(0.0)
    assert promptest.measure(10, 25) == -15
    assert promptest.measure(10, 5) == -10
    promptest.believe()
    assert promptest.measure(10, 10) == 0.0


def test_the_drift_allowance_is_subtracted_from_each_measurement() -> None:
    promptest = MinimumDelay(0.01)
    assert promptest.measure(1000, 900) == 90
    assert promptest.measure(1000, 1000) == 80


def test_the_remembered_lateness_has_an_upper_limit() -> None:
    promptest = MinimumDelay(0.0, most=1000)
    assert promptest.add(5000, 0) == 5000
    assert promptest.late == 1000


@pytest.mark.parametrize("offset", [0, 10**18, -(10**18)])
@given(delays=st.lists(st.integers(0, 10**9), min_size=1, max_size=30))
def test_without_drift_the_lateness_is_the_delay_above_the_minimum_at_any_clock_offset(
    offset: int, delays: list[int]
) -> None:
    promptest, left, last_arrival = MinimumDelay(0.0), offset, delays[0]
    for number, delay in enumerate(delays):
        departure, arrival = offset + 50 * number, 50 * number + delay
        promptest.add(arrival - last_arrival, departure - left)
        left, last_arrival = departure, arrival
        assert promptest.late == delay - min(delays[: number + 1])
