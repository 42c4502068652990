"""Tests of lateness relative to the minimum delay so far.

The two clocks were never compared.
"""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.link.minimum_delay import MinimumDelay


def test_the_first_is_the_promptest() -> None:
    assert MinimumDelay(0.0).late == 0.0


def test_what_is_late_is_so_by_what_the_two_clocks_differ_in() -> None:
    promptest = MinimumDelay(0.0)
    assert promptest.add(ours=30, theirs=10) == 20
    assert promptest.late == 20
    assert promptest.add(ours=10, theirs=15) == 15
    assert promptest.late == 15


def test_one_that_is_prompter_is_the_promptest_from_then_on() -> None:
    promptest = MinimumDelay(0.0)
    assert promptest.add(10, 13) == -3
    assert promptest.late == 0.0
    assert promptest.add(10, 10) == 0.0
    assert promptest.add(13, 10) == 3


def test_the_drift_is_forgiven_by_the_time_that_passed_and_no_further_than_prompt() -> None:
    promptest = MinimumDelay(0.01)
    assert promptest.add(200, 100) == 100  # the drift allowance comes afterwards
    assert promptest.late == 98
    promptest.add(1000, 1000)
    assert promptest.late == 88
    promptest.add(10_000, 10_000)
    assert promptest.late == 0.0


def test_one_that_is_measured_and_not_believed_leaves_the_promptest_as_it_is() -> None:
    promptest = MinimumDelay(0.0)
    assert promptest.measure(10, 25) == -15
    assert promptest.measure(10, 5) == -10
    promptest.believe()
    assert promptest.measure(10, 10) == 0.0


def test_the_drift_is_forgiven_of_all_that_is_measured() -> None:
    promptest = MinimumDelay(0.01)
    assert promptest.measure(1000, 900) == 90
    assert promptest.measure(1000, 1000) == 80


def test_no_more_than_the_most_is_remembered() -> None:
    promptest = MinimumDelay(0.0, most=1000)
    assert promptest.add(5000, 0) == 5000
    assert promptest.late == 1000


@pytest.mark.parametrize("offset", [0, 10**18, -(10**18)])
@given(delays=st.lists(st.integers(0, 10**9), min_size=1, max_size=30))
def test_without_drift_it_is_the_delay_beyond_the_least_whatever_the_clocks_say(
    offset: int, delays: list[int]
) -> None:
    promptest, left, came = MinimumDelay(0.0), offset, delays[0]
    for number, delay in enumerate(delays):
        departure, arrival = offset + 50 * number, 50 * number + delay
        promptest.add(arrival - came, departure - left)
        left, came = departure, arrival
        assert promptest.late == delay - min(delays[: number + 1])
