"""Whether a robot is there, silent or gone."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.bus.subscription import MAX_QUEUED_SAMPLES
from acsard.client.follower import (
    FIRST_STATE_TIMEOUT_S,
    FLEET_QUERY_PERIOD_S,
    MONOTONIC_COUNTERS,
    QUERY_PERIOD_S,
    ROBOT_SILENCE_TIMEOUT_S,
    Follower,
    Watch,
    restarted,
)
from acsard.client.follower import UNREADABLE as UNREADABLE_TEXT
from acsard.core.messages.schema import RobotState, Time
from tests.unit.screens import BEFORE, STATE, raw_sample, sample_of

TICK = 0.01


def at(sec: int) -> RobotState:
    return replace(STATE, stamp=Time(sec))


def query_times(follower: Follower, since: float, until: float) -> list[float]:
    """Return the times at which the follower queries the state."""
    times = [since + n * TICK for n in range(round((until - since) / TICK))]
    return [now for now in times if follower.query_is_due(now)]


def test_a_robot_is_queried_at_even_intervals_unless_it_publishes_often() -> None:
    times = query_times(Follower(0.0), 0.0, 10.0)
    even = [QUERY_PERIOD_S * n for n in range(1, len(times) + 1)]
    assert times == pytest.approx(even, abs=10 * TICK)
    assert len(times) > 25
    follower = Follower(0.0)
    for n in range(100):
        assert not query_times(follower, n / 10, (n + 1) / 10)
        follower.published(at(n), (n + 1) / 10)


def test_a_robot_that_never_sent_a_state_is_reported_silent_after_a_longer_time() -> None:
    follower = Follower(0.0)
    assert not follower.silent(FIRST_STATE_TIMEOUT_S - TICK)
    assert follower.silent(FIRST_STATE_TIMEOUT_S + TICK)
    follower.published(STATE, 10.0)
    assert (follower.state, follower.age(10.5)) == (STATE, 0.5)
    assert not follower.silent(10.0 + ROBOT_SILENCE_TIMEOUT_S - TICK)
    assert follower.silent(10.0 + ROBOT_SILENCE_TIMEOUT_S + TICK)


def test_a_robot_that_is_rarely_queried_is_not_silent_between_its_answers() -> None:
    follower, now = Follower(0.0, FLEET_QUERY_PERIOD_S), 0.0
    follower.published(at(1), now)
    for sec in range(2, 10):
        (now,) = query_times(follower, now, now + 1.5 * FLEET_QUERY_PERIOD_S)
        now += 0.5
        assert not follower.silent(now)
        assert follower.answered(at(sec), now)


def test_a_changed_answer_is_a_sign_of_life_and_what_a_storage_repeats_is_none() -> None:
    follower = Follower(0.0)
    assert follower.query_is_due(1.0)
    # The first answer may be stored, so a second query follows at once.
    assert not follower.answered(at(5), 1.1)
    assert (follower.state, follower.is_confirmed) == (at(5), False)
    assert follower.query_is_due(1.1)
    assert follower.answered(at(6), 1.2)
    assert (follower.is_confirmed, follower.age(1.2)) == (True, 0.0)
    for n in range(10):
        assert not follower.answered(at(6), 2.0 + n)
    assert follower.age(12.2) == 11.0
    # A robot whose clock was set back has a new stamp in its second answer. A published state
    # counts whatever its stamp is.
    assert not follower.answered(at(3), 13.0)
    assert follower.answered(at(4), 14.0)
    follower.published(at(1), 15.0)
    assert (follower.state, follower.age(15.0)) == (at(1), 0.0)


def test_decreasing_counters_show_a_restarted_daemon() -> None:
    assert not restarted(None, STATE)
    assert not restarted(BEFORE, STATE)
    assert restarted(STATE, BEFORE)
    assert restarted(STATE, replace(STATE, counters={}))
    assert not restarted(replace(STATE, counters={}), STATE)
    assert not restarted(STATE, STATE)
    assert not restarted(replace(STATE, counters={}), replace(STATE, counters={}))
    one = MONOTONIC_COUNTERS[0]
    fewer = STATE.counters | {one: STATE.counters[one] - 1}
    assert restarted(STATE, replace(STATE, counters=fewer))


class Robot:
    """A client whose robot has published these samples and answers with `answer`."""

    def __init__(self) -> None:
        self.queue: deque[Any] = deque()
        self.answer: Any = None
        self.followed = True

    def subscribe(self, name: str) -> Any:
        assert name == "state"
        return SimpleNamespace(try_recv=self._next, undeclare=self._end)

    def _next(self) -> Any:
        return self.queue.popleft() if self.queue else None

    def _end(self) -> None:
        self.followed = False

    def start_query(self, name: str, take: Any) -> None:
        assert name == "state"
        if self.answer is not None:
            take(self.answer)


UNREADABLE = raw_sample(b"{}")


@pytest.mark.parametrize(("answer", "expected"), [(2, [3]), (3, [2, 3])])
def test_states_and_answers_come_in_order_of_their_stamps(answer: int, expected: list[int]) -> None:
    robot = Robot()
    watch = Watch(robot, 0.0)
    robot.queue.append(sample_of(at(1)))
    assert watch.poll(0.0) == [at(1)]
    robot.answer = sample_of(at(answer))
    watch.poll(QUERY_PERIOD_S + 0.1)
    robot.queue.append(sample_of(at(5 - answer)))
    assert watch.poll(QUERY_PERIOD_S + 0.2) == [at(n) for n in expected]
    assert watch.state == at(3)
    watch.end()
    assert not robot.followed


def test_unreadable_messages_are_counted_until_a_readable_one_and_a_flood_blocks_nobody() -> None:
    robot = Robot()
    watch = Watch(robot, 0.0)
    robot.queue.extend([UNREADABLE] * (MAX_QUEUED_SAMPLES + 7))
    assert watch.poll(0.0) == []
    assert (watch.unreadable, len(robot.queue)) == (MAX_QUEUED_SAMPLES, 7)
    assert watch.silence(FIRST_STATE_TIMEOUT_S + TICK) == UNREADABLE_TEXT
    robot.queue.append(sample_of(at(1)))
    watch.poll(0.0)
    assert watch.unreadable == 0
    assert "nothing received" in watch.silence(FIRST_STATE_TIMEOUT_S + TICK)
