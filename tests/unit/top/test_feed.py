"""`acsard top` shows the current state at once and recognizes a silence."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any, cast

import pytest
from msgspec.structs import replace

from acsard.bus.address import Address
from acsard.bus.subscription import Subscription
from acsard.client.connection import Connection
from acsard.client.follower import FIRST_STATE_TIMEOUT_S, ROBOT_SILENCE_TIMEOUT_S
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.schema import Info, RobotState, Time
from acsard.host.errors import ReplyError
from acsard.top import feed as top_feed
from acsard.top.feed import Feed
from tests.unit.top.screens import BEFORE, INFO, STATE, sample_of

KEY = "acsard/acsar/state"


class Robot:
    """A client without a bus that gives states at times set by the test."""

    where = Address("tcp/127.0.0.1:7448", "acsar", "")

    def __init__(self) -> None:
        self.now = 100.0
        self.state: RobotState | DecodeError = STATE
        self.queue: deque[Any] = deque()

    def start_query(self, name: str, take: Any) -> None:
        """Do nothing: the query of the follower gets no answer."""

    def key(self, name: str) -> str:
        return f"acsard/acsar/{name}"

    def get(self, name: str) -> RobotState | Info:
        if name == "info":
            return INFO
        if isinstance(self.state, DecodeError):
            raise self.state
        return self.state

    def subscribe(self, name: str) -> Subscription:
        assert name == "state"
        return Subscription(self, KEY)

    def try_recv(self) -> Any:
        return self.queue.popleft() if self.queue else None

    def tells(self, state: RobotState, key: str = KEY) -> None:
        self.queue.append(sample_of(state, key))


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Robot:
    robot = Robot()
    monkeypatch.setattr(top_feed, "clock", SimpleNamespace(steady_s=lambda: robot.now))
    return robot


def feed_of(robot: Robot) -> Feed:
    return Feed(cast(Connection, robot))


def at(sec: int, lines: int = 1300) -> RobotState:
    counters = STATE.counters | {"lines": lines}
    return replace(STATE, stamp=Time(sec), counters=counters)


def test_a_query_gets_the_present_state_before_one_is_published(robot: Robot) -> None:
    feed = feed_of(robot)
    assert feed.screen_data().state is None
    feed.query_state()
    assert feed.screen_data().state == STATE


def test_two_queries_give_two_states_to_compute_rates(robot: Robot) -> None:
    feed = feed_of(robot)
    robot.state = BEFORE
    feed.query_state()
    robot.state = STATE
    feed.query_state()
    assert (feed.screen_data().before, feed.screen_data().state) == (BEFORE, STATE)


def test_the_time_between_two_states_is_measured_by_the_viewer_s_clock(robot: Robot) -> None:
    feed = feed_of(robot)
    assert feed.screen_data().passed == 0.0
    feed.query_state()
    robot.now += 0.8
    robot.state = at(9000)
    feed.query_state()
    assert feed.screen_data().passed == pytest.approx(0.8)


@pytest.mark.parametrize("sec", [999, 1001])
def test_the_later_of_an_answer_and_a_published_state_is_shown(robot: Robot, sec: int) -> None:
    feed = feed_of(robot)
    robot.state = at(1000)
    robot.tells(at(sec, lines=1300 + sec - 1000))
    feed.query_state()
    feed.poll()
    state = feed.screen_data().state
    assert state is not None
    assert state.stamp == Time(max(1000, sec))


def test_a_put_on_a_wildcard_is_not_a_state(robot: Robot) -> None:
    feed = feed_of(robot)
    robot.tells(STATE, "acsard/**")
    feed.poll()
    assert feed.screen_data().state is None


def test_a_state_of_another_version_is_reported_as_such(robot: Robot) -> None:
    feed = feed_of(robot)
    robot.state = DecodeError("wrong_shape", "unknown field")
    with pytest.raises(ReplyError, match="a different version"):
        feed.query_state()
    assert feed.screen_data().undecodable == 1


def test_a_silence_is_reported_sooner_once_a_state_has_arrived(robot: Robot) -> None:
    feed = feed_of(robot)
    robot.now += FIRST_STATE_TIMEOUT_S - 0.01
    assert not feed.screen_data().silent
    robot.now += 0.02
    assert feed.screen_data().silent
    robot.tells(STATE)
    feed.poll()
    robot.now += ROBOT_SILENCE_TIMEOUT_S - 0.01
    assert not feed.screen_data().silent
    robot.now += 0.02
    assert feed.screen_data().silent


def test_the_rates_begin_again_when_another_daemon_answers(robot: Robot) -> None:
    feed = feed_of(robot)
    robot.tells(STATE)
    feed.poll()
    robot.now += 0.1
    robot.tells(BEFORE)  # its counters are smaller
    feed.poll()
    assert (feed.screen_data().before, feed.screen_data().state) == (BEFORE, BEFORE)
