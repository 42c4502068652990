"""Whether a robot is there, silent or gone."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any

from msgspec.structs import replace

from acsard.bus.subscription import MAX_QUEUED_SAMPLES
from acsard.client.follower import (
    FIRST_STATE_TIMEOUT_S,
    FLEET_QUERY_PERIOD_S,
    QUERY_PERIOD_S,
    ROBOT_SILENCE_TIMEOUT_S,
    Follower,
    Watch,
)
from acsard.core.messages.schema import RobotState, Time
from tests.unit.screens import STATE, raw_sample, sample_of

TICK = 0.01


def at(sec: int) -> RobotState:
    return replace(STATE, stamp=Time(sec))


def query_times(follower: Follower, since: float, until: float) -> list[float]:
    """Return the times at which the follower queries the state."""
    times = [since + n * TICK for n in range(round((until - since) / TICK))]
    return [now for now in times if follower.query_is_due(now)]


def test_a_robot_that_never_sent_a_state_is_reported_silent_after_a_longer_time() -> None:
    follower = Follower(0.0)
    assert not follower.silent(FIRST_STATE_TIMEOUT_S - TICK)
    assert follower.silent(FIRST_STATE_TIMEOUT_S + TICK)
    follower.published(STATE, 10.0)
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


def test_the_state_that_a_storage_repeats_is_no_sign_of_life() -> None:
    follower = Follower(0.0)
    follower.published(at(5), 1.0)
    for n in range(10):
        assert not follower.answered(at(5), 2.0 + n)
        assert not follower.answered(at(4), 2.0 + n)
    assert follower.age(12.0) == 11.0
    assert follower.state == at(5)


def test_the_second_answer_of_a_robot_with_a_set_back_clock_is_a_sign_of_life() -> None:
    follower = Follower(0.0)
    follower.published(at(10**6), 1.0)
    assert not follower.answered(at(3), 2.0)
    assert follower.answered(at(4), 3.0)
    assert follower.state == at(4)


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


def test_a_state_published_after_the_answer_replaces_the_answer() -> None:
    robot = Robot()
    watch = Watch(robot, 0.0)
    robot.queue.append(sample_of(at(1)))
    watch.poll(0.0)
    robot.answer = sample_of(at(2))
    watch.poll(QUERY_PERIOD_S + 0.1)
    robot.queue.append(sample_of(at(3)))
    assert watch.poll(QUERY_PERIOD_S + 0.2) == [at(3)]
    assert watch.state == at(3)


def test_a_flood_of_messages_does_not_block_the_caller() -> None:
    robot = Robot()
    watch = Watch(robot, 0.0)
    robot.queue.extend([UNREADABLE] * (MAX_QUEUED_SAMPLES + 7))
    watch.poll(0.0)
    assert len(robot.queue) == 7
