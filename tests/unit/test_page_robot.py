"""The page's server follows its robot, and finds out that it is silent."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, cast

import msgspec
import pytest
import zenoh
from msgspec.structs import replace

from acsard.bus.address import Address
from acsard.client.connection import Connection
from acsard.client.follower import (
    FIRST_STATE_TIMEOUT_S,
    QUERY_PERIOD_S,
    ROBOT_SILENCE_TIMEOUT_S,
    Watch,
)
from acsard.core.config.settings import Config
from acsard.core.messages.schema import Time
from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.errors import NoAnswerError, UnreachableError
from acsard.web import followed_robot
from acsard.web.followed_robot import (
    PATH_POINTS,
    PROCESS_PERIOD_S,
    About,
    FollowedRobot,
    PathHistory,
)
from acsard.web.metrics import Counts
from acsard.web.streams import Stream, Streams
from tests.system.harness import until
from tests.unit.screens import INFO, STATE, raw_sample, sample_of
from tests.unit.test_client_follower import UNREADABLE, Robot

UNREADABLE_BYTES = raw_sample(b"\xff")
ABOUT = About("1", False, 1.0, 4.0, 10.0, "", {"teleop": 0.25, "app": 0.25})


class World:
    """A page's robot in virtual time, which advances each time the page looks at the robot."""

    def __init__(self) -> None:
        self.now, self.asked = 100.0, 0
        self.answers: Callable[[], Any] = lambda: None
        never: Any = None
        self.followed = FollowedRobot(Address("tcp/x:1", "acsar", ""), never, ABOUT, Counts())
        self.robot = Answering(self)

    def state(self) -> Any:
        return sample_of(replace(STATE, stamp=Time.from_ns(round(self.now * NS_PER_S))))

    def reachability_changes(
        self, seconds: float, publishes: Callable[[float], Any]
    ) -> list[tuple[float, str]]:
        """Run for this time, and return each change of `gone` with the time of its report.

        `publishes` returns the sample that the robot publishes at a time, or None.
        """
        changes: list[tuple[float, str]] = []
        watch = self.followed._watch = Watch(cast(Any, self.robot), self.now)
        began, before = self.now, self.followed.gone
        while self.now - began < seconds:
            if (sample := publishes(self.now - began)) is not None:
                self.robot.queue.append(sample)
            self.followed._look(watch, self.now)
            if self.followed.gone != before:
                before = self.followed.gone
                changes.append((self.now - began, before))
            self.now += PROCESS_PERIOD_S
        return changes


class Answering(Robot):
    """A client whose queries are answered by the test's `World`."""

    def __init__(self, world: World) -> None:
        super().__init__()
        self._world = world

    def start_query(self, name: str, take: Any) -> None:
        self._world.asked += 1
        self.answer = self._world.answers()
        super().start_query(name, take)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    result = World()
    monkeypatch.setattr(clock, "steady_s", lambda: result.now)
    return result


def test_a_robot_that_falls_silent_is_reported_within_its_time(world: World) -> None:
    world.followed._about_due_s = math.inf
    changes = world.reachability_changes(10.0, lambda t: world.state() if t < 5.0 else None)
    (_, here), (at, reason) = changes
    assert here == ""
    assert world.followed._about_due_s == 0.0, "its facts may be others now"
    assert "nothing is received from the daemon at tcp/x:1" in reason
    assert (
        4.9 + ROBOT_SILENCE_TIMEOUT_S - PROCESS_PERIOD_S
        <= at
        <= 5.0 + ROBOT_SILENCE_TIMEOUT_S + 2 * PROCESS_PERIOD_S
    )


def test_a_robot_that_publishes_once_in_ten_seconds_is_queried_and_is_not_gone(
    world: World,
) -> None:
    world.answers = world.state
    changes = world.reachability_changes(
        30.0, lambda t: world.state() if round(t * 10) % 100 == 0 else None
    )
    assert [reason for _, reason in changes] == [""]
    assert world.asked > 30.0 / (2 * QUERY_PERIOD_S + 2 * PROCESS_PERIOD_S)


def test_a_daemon_of_another_version_is_reported_as_such(world: World) -> None:
    assert world.followed.gone == "no daemon answers at tcp/x:1 yet"
    ((at, reason),) = world.reachability_changes(10.0, lambda t: UNREADABLE)
    assert "another version" in reason
    assert at <= FIRST_STATE_TIMEOUT_S + 2 * PROCESS_PERIOD_S


def test_the_messages_that_cannot_be_read_are_counted(world: World) -> None:
    world.reachability_changes(2.0, lambda t: UNREADABLE if 0.98 < t < 1.22 else world.state())
    assert world.followed._counts.all() == {"unreadable": 5}


async def test_a_stream_keeps_a_message_before_an_answer_and_has_null_for_a_damaged_one() -> None:
    stream = Stream()
    assert stream.value()[:2] == (0, b"null")
    for store, x in ((stream.answered, 1.0), (stream.take, 2.0), (stream.answered, 3.0)):
        store(sample_of(replace(STATE, x=x)))
        assert msgspec.json.decode(stream.value()[1])["x"] == min(x, 2.0)
    stream.take(UNREADABLE_BYTES)
    assert stream.value()[:2] == (3, b"null")


class AnsweringRobot(Robot):
    """A client whose robot also answers with its version and its configuration."""

    def __init__(self, failures: int) -> None:
        super().__init__()
        self._failures = failures

    def get(self, name: str) -> Any:
        if self._failures:
            self._failures -= 1
            raise NoAnswerError("no answer")
        return INFO if name == "info" else msgspec.to_builtins(Config())


async def test_the_page_learns_about_its_robot_although_it_was_not_there_at_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("RETRY_DELAY_S", "ABOUT_RETRY_S", "PROCESS_PERIOD_S"):
        monkeypatch.setattr(followed_robot, name, 0.001)
    client, attempts = AnsweringRobot(failures=2), iter([UnreachableError("nobody is there")])
    client.queue.append(sample_of(STATE))

    def connect() -> Any:
        for error in attempts:
            raise error
        return client

    page = FollowedRobot(Address("tcp/x:1", "acsar", ""), connect, ABOUT, Counts())
    running = asyncio.create_task(page.run())
    async with asyncio.timeout(5.0):
        while page.about.version != INFO.version:
            await asyncio.sleep(0.001)
    assert not running.done()
    assert page.gone == ""
    running.cancel()


@pytest.mark.parametrize("method", ["update", "poll"])
async def test_a_bus_that_hangs_does_not_hide_the_silence_of_its_robot(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs, ends = threading.Event(), threading.Event()
    owner: Any = Streams if method == "update" else Watch
    work = getattr(owner, method)

    def hanging(*args: Any) -> Any:
        if hangs.is_set():
            ends.wait(20.0)
        return work(*args)

    monkeypatch.setattr(owner, method, hanging)
    client = AnsweringRobot(failures=0)
    client.queue.append(sample_of(STATE))
    page = FollowedRobot(
        Address("tcp/x:1", "acsar", ""), lambda: cast(Any, client), ABOUT, Counts()
    )
    running = asyncio.create_task(page.run())
    try:
        async with asyncio.timeout(10.0):
            while page.gone:
                await asyncio.sleep(0.01)
            hangs.set()
            while not page.gone:
                await asyncio.sleep(0.01)
    finally:
        running.cancel()
        ends.set()


def test_the_path_keeps_ten_minutes_a_bounded_number_of_points_and_the_newest_place() -> None:
    path = PathHistory()
    for n in range(30_000):
        path.add(n / 10, n / 100, 0.0)
    first, *_, last = path.points()
    assert first == pytest.approx((240.0, 0.0), abs=0.1)
    assert last == (299.99, 0.0)
    for n in range(20_000):
        path.add(3000 + n / 100, 300 + n / 10, 0.0)
    assert len(path.points()) == PATH_POINTS + 1


def test_the_path_begins_again_when_the_pose_is_set_and_is_a_point_while_the_robot_rests() -> None:
    path = PathHistory()
    assert path.points() == []
    for n in range(10):
        path.add(n / 10, 0.1 * n, 0.0)
    for n in range(10):
        path.add(1 + n / 10, 50.0, 2.0)
    assert set(path.points()) == {(50.0, 2.0)}
    assert len(path.points()) == 2


KEY = "acsard/acsar/events"


@pytest.fixture(scope="module")
def session() -> Iterator[zenoh.Session]:
    """Yield a session that reaches no other program."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    with zenoh.open(config) as session:
        yield session


@pytest.fixture(scope="module")
def samples(session: zenoh.Session) -> list[zenoh.Sample]:
    """Return two samples of the key."""
    subscriber = session.declare_subscriber(KEY)
    for payload in (b"1", b"2"):
        session.put(KEY, payload, encoding="application/json")
    return [subscriber.recv(), subscriber.recv()]


def test_the_age_of_a_message_counts_a_suspend(
    samples: list[zenoh.Sample], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The age must include the suspend, in which the monotonic clock stands still."""
    stream = Stream()
    stream.take(samples[0])
    slept_ns = clock.asleep_ns() + 3600 * NS_PER_S
    monkeypatch.setattr(clock, "asleep_ns", lambda: slept_ns)
    assert stream.value()[2] >= 3_600_000.0


def test_a_put_on_a_wildcard_is_not_a_message_of_the_key(session: zenoh.Session) -> None:
    streams, client = Streams(), Connection(session, "acsar", "app")
    stream = streams.follow("events")
    streams.update(client)
    for key, payload in ((KEY, b"1"), ("acsard/**", b"666"), ("acsard/*/*", b"667"), (KEY, b"2")):
        session.put(key, payload, encoding="application/json")
    until(lambda: stream.value()[1] == b"2", 10.0, "it arrives on a Zenoh thread")
    assert stream.number == 2
    streams.leave("events")
    streams.update(client)
    session.put(KEY, b"3", encoding="application/json")
    time.sleep(0.1)
    assert stream.value()[:2] == (2, b"2")
