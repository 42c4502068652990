"""Tests of the binding of a follower to the bus: what is decoded, queried and bounded."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any

from msgspec.structs import replace

from acsard.client.follower import ASK_S, SILENT_S
from acsard.client.watch import Watch
from acsard.core.messages.encodings import encode
from acsard.core.messages.schema import RobotState, Time
from acsard.daemon.bus.subscription import QUEUED
from tests.unit.top.screens import STATE


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

    def ask(self, name: str, take: Any) -> None:
        assert name == "state"
        if self.answer is not None:
            take(self.answer)


def sample_of(state: RobotState) -> Any:
    payload = SimpleNamespace(to_bytes=lambda: encode(state, "json"))
    return SimpleNamespace(encoding="application/json", payload=payload)


def at(sec: int) -> RobotState:
    return replace(STATE, stamp=Time(sec))


UNREADABLE = SimpleNamespace(
    encoding="application/json", payload=SimpleNamespace(to_bytes=lambda: b"{}")
)


def test_the_states_that_arrived_are_returned_in_order() -> None:
    robot = Robot()
    watch = Watch(robot, 0.0)
    robot.queue.extend(map(sample_of, (at(1), at(2))))
    assert watch.look(0.1) == [at(1), at(2)]
    assert watch.look(0.2) == []
    assert watch.age(0.2) == 0.1


def test_an_answer_counts_less_than_a_state_that_was_published_later() -> None:
    robot = Robot()
    watch = Watch(robot, 0.0)
    robot.queue.append(sample_of(at(1)))
    watch.look(0.0)
    robot.answer = sample_of(at(2))
    watch.look(ASK_S + 0.1)
    robot.queue.append(sample_of(at(3)))
    assert watch.look(ASK_S + 0.2) == [at(3)]
    assert watch.state == at(3)


def test_a_state_that_was_published_before_the_answer_comes_first() -> None:
    robot = Robot()
    watch = Watch(robot, 0.0)
    robot.queue.append(sample_of(at(1)))
    watch.look(0.0)
    robot.answer = sample_of(at(3))
    watch.look(ASK_S + 0.1)
    robot.queue.append(sample_of(at(2)))
    assert watch.look(ASK_S + 0.2) == [at(2), at(3)]


def test_messages_that_cannot_be_read_are_counted_until_one_can() -> None:
    robot = Robot()
    watch = Watch(robot, 0.0)
    robot.queue.extend([UNREADABLE] * 3)
    assert watch.look(0.0) == []
    assert watch.unreadable == 3
    robot.queue.append(sample_of(at(1)))
    watch.look(0.0)
    assert watch.unreadable == 0


def test_a_flood_does_not_hold_the_caller() -> None:
    robot = Robot()
    watch = Watch(robot, 0.0)
    robot.queue.extend([UNREADABLE] * (QUEUED + 7))
    watch.look(0.0)
    assert len(robot.queue) == 7


def test_commands_have_no_effect_on_a_daemon_that_is_silent_or_objects() -> None:
    robot = Robot()
    watch = Watch(robot, 0.0)
    assert watch.objection("app", STATE.sender, 0.0) == ""
    robot.queue.append(sample_of(STATE))
    watch.look(0.0)
    assert watch.objection("app", STATE.sender, 0.0) == ""
    assert "nothing received from the daemon" in watch.objection(
        "app", STATE.sender, SILENT_S + 0.01
    )
    stopped = replace(STATE, mode="stopped", reason="stopped by request")
    robot.queue.append(sample_of(stopped))
    watch.look(5.0)
    assert watch.objection("app", STATE.sender, 5.0) == "stopped by request"


def test_the_subscription_ends_with_the_watch() -> None:
    robot = Robot()
    Watch(robot, 0.0).end()
    assert not robot.followed
