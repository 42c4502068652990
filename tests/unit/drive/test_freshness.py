"""A command that comes too late is refused, whatever the clocks say."""

from __future__ import annotations

from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.config.settings import Source
from acsard.drive.freshness import NEXT, Freshness, Sign, State
from acsard.values import NS_PER_S
from tests.unit.drive.commanders import HIGH, HOUR_NS, LOW, MS, SLOW, Bench

# the age of stamped commands


def test_a_prompt_stamp_is_accepted_whatever_the_clocks_say() -> None:
    for offset_ns in (0, HOUR_NS, -HOUR_NS, -1_800_000_000 * NS_PER_S, 1 << 62):
        bench = Bench(HIGH)
        bench.offset_ns = offset_ns
        for _ in range(10):
            assert bench.stamped(HIGH) == ""
            bench.wait(50)
        assert bench.driver() == "high"


def test_a_command_later_than_the_promptest_by_more_than_the_timeout_is_stale() -> None:
    bench = Bench(HIGH)
    assert bench.stamped(HIGH) == ""
    assert bench.stamped(HIGH, late_ms=250) == ""
    assert bench.stamped(HIGH, late_ms=250.000001) == "stale"


@pytest.mark.parametrize("source", [SLOW, Source("quick", 1, timeout=0.02)])
def test_how_late_is_stale_depends_on_the_source(source: Source) -> None:
    bench = Bench(source)
    bench.stamped(source)
    assert bench.stamped(source, late_ms=source.timeout * 1000) == ""
    assert bench.stamped(source, late_ms=source.timeout * 1000 + 1) == "stale"


def test_a_stale_command_refreshes_nothing() -> None:
    bench = Bench(HIGH)
    bench.stamped(HIGH)
    for _ in range(5):
        bench.wait(51)
        assert bench.stamped(HIGH, late_ms=5000) == "stale"
    assert bench.driver() == ""


def test_a_backlog_is_not_obeyed_and_what_is_fresh_again_is() -> None:
    bench = Bench(HIGH)
    bench.stamped(HIGH)
    bench.wait(3000)
    ages = [float(age) for age in range(3000, -1, -50)]
    answers = [bench.stamped(HIGH, late_ms=age) for age in ages]
    # the sender has been silent for 3 s: its minimum may have risen by 3 s x 2e-4 = 0.6 ms
    assert answers == ["stale" if age > 250.6 else "" for age in ages]


def test_a_promptest_command_makes_the_later_ones_late() -> None:
    bench = Bench(HIGH)
    assert bench.stamped(HIGH, late_ms=400) == ""
    assert bench.stamped(HIGH, late_ms=0) == ""
    assert bench.stamped(HIGH, late_ms=400) == "stale"


def test_each_sender_has_its_own_clock() -> None:
    bench = Bench(HIGH, LOW)
    bench.stamped(HIGH, clock="alice")
    bench.offset_ns -= HOUR_NS
    assert bench.stamped(HIGH, clock="bob") == ""
    assert bench.stamped(HIGH, clock="alice") == "stale"


def test_a_sender_is_known_by_its_source_when_it_has_no_name() -> None:
    bench = Bench(HIGH, LOW)
    bench.stamped(HIGH)
    bench.offset_ns -= HOUR_NS
    assert bench.stamped(LOW) == ""
    assert bench.stamped(HIGH) == "stale"


def test_one_sender_has_one_clock_on_all_its_sources() -> None:
    bench = Bench(HIGH, LOW)
    bench.stamped(HIGH, clock="alice")
    assert bench.stamped(LOW, late_ms=300, clock="alice") == "stale"


def test_a_command_without_a_stamp_is_as_old_as_its_arrival() -> None:
    bench = Bench(HIGH)
    bench.stamped(HIGH)
    assert bench.wait(5000).send(HIGH) == ""


@pytest.mark.parametrize("offset_s", [1_800_000_000, -1_800_000_000])
def test_a_sender_that_was_silent_for_long_may_have_set_its_clock(offset_s: int) -> None:
    bench = Bench(HIGH)
    bench.offset_ns = offset_s * NS_PER_S
    bench.stamped(HIGH)
    bench.offset_ns -= HOUR_NS
    bench.wait(10_000)
    assert bench.stamped(HIGH) == "stale"
    bench.wait(10_001)
    refused = [bench.wait(100).stamped(HIGH) for _ in range(25)]
    assert refused == ["stale"] * 20 + [""] * 5  # steady delays prove it in 2 s


def test_a_sender_that_was_silent_for_just_ten_seconds_may_not() -> None:
    bench = Bench(HIGH)
    bench.stamped(HIGH)
    bench.offset_ns -= HOUR_NS
    bench.wait(9_900)
    assert {bench.wait(100).stamped(HIGH) for _ in range(50)} == {"stale"}


def test_what_a_network_held_for_longer_than_that_is_not_taken_for_a_clock_that_was_set() -> None:
    bench = Bench(HIGH)
    bench.stamped(HIGH)
    bench.offset_ns -= 15 * NS_PER_S
    bench.wait(15_000)
    for _ in range(200):  # a backlog that catches up by a tenth of the time it takes
        assert bench.wait(50).stamped(HIGH) == "stale"
        bench.offset_ns += 5 * MS


@pytest.mark.parametrize("drift", [1e-4, -1e-4])
def test_an_hour_with_a_drifting_clock_loses_no_command(drift: float) -> None:
    # 1e-4 x 3600 s = 360 ms: more than the timeout, if nothing followed it
    bench = Bench(HIGH)
    for _ in range(3600 * 5):
        bench.offset_ns -= int(drift * 200 * MS)
        assert bench.wait(200).stamped(HIGH) == ""


def test_a_delay_that_creeps_up_is_noticed_all_the_same() -> None:
    # 1 ms more with each command; in the 50 ms between two the minimum may rise 0.01 ms: late by
    # 0.99 k ms, which is over 250 ms from k = 253
    bench = Bench(HIGH)
    answers = [bench.wait(50).stamped(HIGH, late_ms=late) for late in range(300)]
    assert answers == [""] * 253 + ["stale"] * 47


def test_the_extra_delay_is_measured_from_the_promptest_command() -> None:
    freshness = Freshness()
    assert freshness.late_ns("a", 1000, 5000) == 0.0  # the first: delay 4000
    assert freshness.late_ns("a", 1000, 5500) == pytest.approx(500, abs=1)
    assert freshness.late_ns("a", 3000, 6000) == 0.0  # prompter: delay 3000
    assert freshness.late_ns("a", 3000, 7000) == pytest.approx(1000, abs=1)


def test_the_minimum_rises_with_time_by_the_drift_allowed() -> None:
    freshness = Freshness()
    freshness.late_ns("a", 0, 0)
    silence = 10 * NS_PER_S
    late = freshness.late_ns("a", 0, silence)
    assert late == pytest.approx(silence - 2e-4 * silence)


def test_only_so_many_clocks_are_remembered_and_the_longest_unheard_goes_first() -> None:
    freshness = Freshness()
    for number in range(1024):
        freshness.late_ns(f"sender {number}", 0, 0)
    freshness.late_ns("sender 0", 0, 0)  # heard again: now number 1 is the oldest
    freshness.late_ns("one more", 0, 0)
    assert freshness.late_ns("sender 0", 0, 1000) > 0.0
    assert freshness.late_ns("sender 2", 0, 1000) > 0.0
    assert freshness.late_ns("sender 1", 0, 1000) == 0.0


@given(
    jitter=st.lists(st.floats(0.0, 249.0), min_size=1, max_size=50),
    offset_s=st.floats(-1e9, 1e9),
)
def test_no_command_within_the_timeout_is_ever_stale(jitter: list[float], offset_s: float) -> None:
    bench = Bench(HIGH)
    bench.offset_ns = int(offset_s * NS_PER_S)
    for late in jitter:
        assert bench.wait(50).stamped(HIGH, late_ms=late) == ""


def test_holes_that_each_add_a_little_delay_do_not_add_up() -> None:
    bench = Bench(HIGH)
    bench.stamped(HIGH)
    bench.wait(10_100)
    assert bench.stamped(HIGH, late_ms=99.0) == ""
    bench.wait(10_100)
    assert bench.stamped(HIGH, late_ms=297.0) == "stale"


# a clock that may have been set


LATE_NS = 3600 * NS_PER_S


def returned() -> Freshness:
    """A clock that was prompt at 0, and an hour late at 20 s after a long silence."""
    freshness = Freshness()
    freshness.late_ns("a", 0, 0)
    assert freshness.late_ns("a", 20 * NS_PER_S - LATE_NS, 20 * NS_PER_S) > LATE_NS / 2
    return freshness


def late_s(freshness: Freshness, at_s: float, delay_s: float) -> float:
    """How late one is that arrives then, after such a delay."""
    at_ns = round(at_s * NS_PER_S)
    return freshness.late_ns("a", at_ns - round(delay_s * NS_PER_S), at_ns) / NS_PER_S


def test_steady_delays_for_two_seconds_prove_a_new_promptest() -> None:
    freshness = returned()
    assert late_s(freshness, 21.999, 3600.0) > 3000
    assert late_s(freshness, 22.0, 3600.1) == pytest.approx(0.1)  # as late as the least of them
    assert late_s(freshness, 22.1, 3600.0) == 0.0


def test_delays_that_waver_by_more_than_a_tenth_of_a_second_begin_the_proof_again() -> None:
    freshness = returned()
    assert late_s(freshness, 21.0, 3600.11) > 3000
    assert late_s(freshness, 22.9, 3600.02) > 3000
    assert late_s(freshness, 23.0, 3600.02) == 0.0


@pytest.mark.parametrize("delay_s", [0.0, 0.104])
def test_who_is_prompt_after_a_long_silence_has_nothing_to_prove(delay_s: float) -> None:
    # The promptest may have risen by 20 s x 2e-4 = 4 ms: 104 ms are just prompt.
    freshness = Freshness()
    late_s(freshness, 0.0, 0.0)
    assert late_s(freshness, 20.0, delay_s) == pytest.approx(max(0.0, delay_s - 0.004))
    assert all(late_s(freshness, tenth / 10, delay_s + 1.0) > 0.9 for tenth in range(201, 240))


def test_another_long_silence_begins_the_proof_again() -> None:
    freshness = returned()
    assert late_s(freshness, 30.001, 3600.0) > 3000
    assert late_s(freshness, 32.0, 3600.0) > 3000
    assert late_s(freshness, 32.001, 3600.0) == 0.0


def test_a_prompt_command_ends_the_proof() -> None:
    freshness = returned()
    # The first wavers against the hour, and begins the proof of being prompt.
    assert [late_s(freshness, at_s, 0.0) for at_s in (20.5, 20.6)] == [0.0, 0.0]
    for tenth in range(250, 290):
        assert late_s(freshness, tenth / 10, 3600.0) > 3000


def test_one_prompt_command_among_late_ones_is_no_end_of_the_proof() -> None:
    freshness = returned()
    late_s(freshness, 20.5, 0.0)
    answers = [late_s(freshness, tenth / 10, 3600.0) > 3000 for tenth in range(206, 228)]
    assert answers == [True] * 20 + [False] * 2


def test_every_state_has_an_entry_for_all_it_may_show() -> None:
    assert {state for state, _ in NEXT} == {*NEXT.values()} == {*get_args(State)}
    assert {sign for _, sign in NEXT} == {*get_args(Sign)}
