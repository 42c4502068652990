"""Tests of the judge of ages and of the beats: each bound of the law, and what lies just within."""

from __future__ import annotations

import pytest

from tests.simulate.ages import Ages
from tests.simulate.beats import Beats
from tests.simulate.roads import NS, Message, Sample

TIMEOUT_NS = NS // 4


def fresh(
    ages: Ages, at_s: float, delay_s: float, clock: str = "ann", beat_s: float | None = None
) -> bool:
    at_ns, sent_ns = int(at_s * NS), int((at_s - delay_s) * NS)
    message = Message(sent_ns, at_ns, 0.3, 0.0, sent_ns, 1, "")
    beat = None if beat_s is None else (1, int(beat_s * NS))
    by = Sample("cmd/app", b"", {}, clock, False, clock, beat)
    return ages.fresh({"source": "app"}, message, by, at_ns, TIMEOUT_NS)


def known(until_s: float, delay_s: float) -> Ages:
    """Return the judge after commands with this delay at 20 Hz, from 1 s on."""
    ages = Ages(0)
    for n in range(20, int(until_s * 20)):
        fresh(ages, n / 20, delay_s)
    return ages


@pytest.mark.parametrize(("delay_s", "allowed"), [(0.34, True), (0.36, False)])
def test_a_command_with_an_echo_is_at_most_a_tenth_of_a_second_older_than_its_timeout(
    delay_s: float, allowed: bool
) -> None:
    assert fresh(Ages(0), 9.0, delay_s, beat_s=8.7) is allowed


def test_a_new_clock_counts_behind_one_timeout_in_which_no_delay_fell() -> None:
    ages = Ages(0)
    assert [fresh(ages, 1.0 + n / 20, 0.5) for n in range(7)] == [False] * 5 + [True] * 2
    falls = Ages(0)
    assert not any(fresh(falls, 1.0 + n / 20, 3.0 - n / 10) for n in range(20))


@pytest.mark.parametrize("pause_s", [0.1, 2.0, 30.0, 600.0])
def test_a_delay_that_began_in_a_pause_makes_each_command_stale(pause_s: float) -> None:
    ages = known(4.0, 0.01)
    assert not any(fresh(ages, 4.0 + pause_s + n / 20, 1.0) for n in range(100))


def test_the_least_delay_rises_by_half_a_millisecond_a_second_and_by_one_timeout_an_hour() -> None:
    assert fresh(known(4.0, 0.01), 104.0, 0.01 + 0.25 + 0.05)
    assert not fresh(known(4.0, 0.01), 104.0, 0.01 + 0.25 + 0.05 + 0.04)
    assert not fresh(known(4.0, 0.01), 3000.0, 0.01 + 2 * 0.25 + 0.04)


def test_a_clock_that_was_silent_for_an_hour_is_new() -> None:
    ages = known(4.0, 0.01)
    assert not fresh(ages, 3610.0, 9.0)
    assert fresh(ages, 3611.0, 9.0)


@pytest.mark.parametrize(("names", "new"), [(15, False), (17, True)])
def test_a_clock_behind_sixteen_others_of_its_source_is_new(names: int, new: bool) -> None:
    ages = known(4.0, 0.01)
    for n in range(names):
        fresh(ages, 4.0, 0.01, f"name {n}")
    fresh(ages, 5.0, 9.0)
    assert fresh(ages, 6.0, 9.0) is new


def test_a_lower_delay_counts_only_behind_a_whole_timeout_of_lower_ones() -> None:
    ages = known(4.0, 1.0)
    assert [fresh(ages, 4.0 + n / 20, 0.1) for n in range(7)] == [False] * 5 + [True] * 2
    assert fresh(known(4.0, 1.0), 4.0, 0.95)


@pytest.mark.parametrize(("lower_s", "obeyed"), [(0.2, True), (3.0, False)])
def test_a_delay_is_late_by_a_lower_one_only_if_that_has_stayed(
    lower_s: float, obeyed: bool
) -> None:
    ages, at_s = known(4.0, 1.0), 4.0
    while at_s < 4.0 + lower_s:
        fresh(ages, at_s, 0.01)
        at_s += 0.05
    assert fresh(ages, at_s, 1.1) is obeyed


def test_one_wild_stamp_among_lower_delays_is_not_their_least() -> None:
    ages = known(4.0, 1.0)
    for n in range(60):
        fresh(ages, 4.0 + n / 20, -1000.0 if n == 1 else 0.5)
    assert fresh(ages, 7.0, 0.5)


@pytest.mark.parametrize("lower_s", [0.05, 0.4])
def test_a_lower_delay_that_may_count_stays_allowed_behind_a_higher_one(lower_s: float) -> None:
    ages = known(4.0, 1.0)
    lower = [fresh(ages, 4.0 + n / 20, 0.1) for n in range(int(lower_s * 20) + 1)]
    assert fresh(ages, 4.5, 1.1)
    assert fresh(ages, 4.55, 0.1) is lower[-1]
    assert not fresh(ages, 4.6, 0.02)


def test_a_robot_that_slept_knows_no_least_delay() -> None:
    ages = known(4.0, 0.01)
    ages.forget_least(5 * NS)
    assert fresh(ages, 5.0, 9.0)


def test_a_sender_echoes_the_beat_that_had_reached_it_when_it_sent() -> None:
    beats, sender = Beats(), {"delay": 0.03, "congestion": [[2.0, 3.0, "jump", 0.4]]}
    beats.begin(0)
    assert beats.newest(sender, NS // 50) is None
    assert beats.newest(sender, NS // 10) == (1, NS // 20)
    assert beats.newest(sender, 5 * NS // 2) == (1, 245 * NS // 100)
    assert beats.newest(sender | {"both_ways": True}, 5 * NS // 2) == (1, 205 * NS // 100)


def test_no_beat_comes_from_a_daemon_that_has_ended_or_a_host_that_sleeps() -> None:
    beats, sender = Beats(), {"delay": 0.0, "congestion": []}
    beats.begin(0)
    beats.end(NS)
    assert beats.newest(sender, 9 * NS) == (1, NS)
    beats.begin(10 * NS)
    assert beats.newest(sender, 11 * NS) == (2, 11 * NS)
    beats.sleep(12 * NS, 60 * NS)
    assert beats.newest(sender, 59 * NS) == (2, 12 * NS)
    assert beats.newest(sender, 61 * NS) == (2, 61 * NS)
