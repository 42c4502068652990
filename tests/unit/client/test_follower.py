"""Tests of the newest state of a robot, of its age, and of what proves that the daemon runs."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from acsard.client.follower import (
    ASK_S,
    FIRST_S,
    FLEET_ASK_S,
    SILENT_S,
    Follower,
    restarted,
)
from acsard.core.messages.schema import RobotState, Time
from tests.unit.top.screens import BEFORE, STATE

TICK = 0.01


def at(sec: int) -> RobotState:
    return replace(STATE, stamp=Time(sec))


def asked(follower: Follower, since: float, until: float) -> list[float]:
    """Return the times at which the follower queries the state."""
    times = [since + n * TICK for n in range(round((until - since) / TICK))]
    return [now for now in times if follower.asks(now)]


def test_a_state_is_as_old_as_the_time_since_its_arrival() -> None:
    follower = Follower(100.0)
    assert follower.age(101.0) == 1.0
    follower.published(STATE, 101.5)
    assert follower.state == STATE
    assert follower.age(102.0) == 0.5


def test_a_robot_that_publishes_often_is_never_queried() -> None:
    follower = Follower(0.0)
    for n in range(100):
        assert not asked(follower, n / 10, (n + 1) / 10)
        follower.published(at(n), (n + 1) / 10)


def test_a_robot_that_publishes_seldom_is_queried_at_even_intervals() -> None:
    times = asked(Follower(0.0), 0.0, 10.0)
    assert times == pytest.approx([ASK_S * n for n in range(1, len(times) + 1)], abs=10 * TICK)
    assert len(times) > 25


def test_a_silent_robot_is_reported_after_a_longer_time_if_it_was_never_heard() -> None:
    follower = Follower(0.0)
    assert not follower.silent(FIRST_S - TICK)
    assert follower.silent(FIRST_S + TICK)
    follower.published(STATE, 10.0)
    assert not follower.silent(10.0 + SILENT_S - TICK)
    assert follower.silent(10.0 + SILENT_S + TICK)


def test_a_robot_that_is_queried_seldom_is_not_silent_between_its_answers() -> None:
    follower, now = Follower(0.0, FLEET_ASK_S), 0.0
    follower.published(at(1), now)
    for sec in range(2, 10):
        (now,) = asked(follower, now, now + 1.5 * FLEET_ASK_S)
        now += 0.5
        assert not follower.silent(now)
        assert follower.answered(at(sec), now)


def test_the_first_answer_does_not_prove_that_the_daemon_runs_and_is_checked_at_once() -> None:
    follower = Follower(0.0)
    assert follower.asks(1.0)
    assert not follower.answered(at(5), 1.1)
    assert follower.state == at(5)
    assert not follower.heard
    assert follower.asks(1.1)
    assert follower.answered(at(6), 1.2)
    assert follower.heard
    assert follower.age(1.2) == 0.0


def test_the_state_that_a_storage_repeats_is_no_sign_of_life() -> None:
    follower = Follower(0.0)
    follower.published(at(5), 1.0)
    for n in range(10):
        assert not follower.answered(at(5), 2.0 + n)
        assert not follower.answered(at(4), 2.0 + n)
    assert follower.age(12.0) == 11.0
    assert follower.state == at(5)


def test_a_robot_whose_clock_was_set_back_is_heard_by_its_second_answer() -> None:
    follower = Follower(0.0)
    follower.published(at(10**6), 1.0)
    assert not follower.answered(at(3), 2.0)
    assert follower.answered(at(4), 3.0)
    assert follower.state == at(4)


def test_a_published_state_counts_whatever_its_stamp_is() -> None:
    follower = Follower(0.0)
    follower.published(at(10**6), 1.0)
    follower.published(at(1), 2.0)
    assert (follower.state, follower.age(2.0)) == (at(1), 0.0)


def test_counters_that_decrease_are_those_of_another_daemon() -> None:
    assert not restarted(None, STATE)
    assert not restarted(BEFORE, STATE)
    assert restarted(STATE, BEFORE)
    assert restarted(STATE, replace(STATE, counters={}))
