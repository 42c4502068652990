"""The Foxglove bridge reads the facts about its robot again after each restart of the daemon."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from msgspec.structs import replace

from acsard.client import Client, synchronous
from acsard.core.config.settings import Config
from acsard.core.messages.signature import public_name
from acsard.core.values import NS_PER_S
from acsard.foxglove import bridge as module
from acsard.foxglove.bridge import Bridge
from acsard.foxglove.robot_facts import Facts
from acsard.host import clock
from acsard.host.errors import NoAnswerError, ReplyError
from tests.unit.foxglove.status_messages import Server

UNREADABLE = ReplyError("cannot read the robot's state; use the same version here")

GONE = "the daemon of robot acsar is gone; `acsard foxglove` waits for it"
BACK = "the daemon of robot acsar is back"


class World:
    """A bridge in virtual time, whose daemon restarts when the test says so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns, self.queries = 100 * NS_PER_S, 0
        self.facts = Facts(Config(), None, ("app",), "")
        self.during_query: Callable[[], object] = lambda: None
        self.printed: list[str] = []
        self.server = Server()
        monkeypatch.setattr(clock, "mono_ns", lambda: self.now_ns)
        monkeypatch.setattr(module, "learn", self._learn)
        monkeypatch.setattr(module, "start", lambda *_, **__: self.server)
        monkeypatch.setattr(logging.getLogger("foxglove"), "handlers", [])
        session: Any = SimpleNamespace(liveliness=lambda: self, zid=lambda: "0123456789abcdef")
        self.bridge = Bridge(Client(session, "acsar", "app"), ("", 0), self.printed.append)
        self.queries = 0

    def declare_subscriber(self, key: str, take: Callable[[Any], None], *, history: bool) -> None:
        self._take = take

    def _learn(self, robot: Client) -> Facts:
        facts, self.queries = self.facts, self.queries + 1
        self.during_query()
        return facts

    def daemon(self, kind: zenoh.SampleKind) -> None:
        """Let the daemon start (PUT) or end (DELETE)."""
        self._take(SimpleNamespace(kind=kind))

    def restart(self) -> None:
        """Restart the daemon with another timeout, so that the test can recognize the new facts."""
        self.daemon(zenoh.SampleKind.DELETE)
        (app,) = (source for source in self.facts.config.commands.sources if source.name == "app")
        sources = (replace(app, timeout=app.timeout + 1.0),)
        commands = replace(self.facts.config.commands, sources=sources)
        self.facts = replace(self.facts, config=replace(Config(), commands=commands))
        self.daemon(zenoh.SampleKind.PUT)

    def passes(self, seconds: float) -> None:
        """Run the bridge for this time, in rounds with the pauses of its main loop."""
        end_ns = self.now_ns + seconds * NS_PER_S
        while self.now_ns < end_ns:
            self.now_ns += round((0.015 if self.bridge._wake.is_set() else 0.5) * NS_PER_S)
            self.bridge._wake.clear()
            self.bridge._round()

    @property
    def known_timeout_s(self) -> float:
        return self.bridge._drives.timeout_s


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


def fail() -> None:
    raise UNREADABLE


def test_the_daemon_logs_a_call_of_a_viewer_under_a_readable_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The daemon replaces each comma in a name by a question mark."""
    monkeypatch.setattr(synchronous, "own_name", lambda: "alice@laptop acsard")
    robot = World(monkeypatch).bridge._robot
    name, _, _ = public_name(robot.caller).rpartition("/")
    assert name == "alice@laptop acsard foxglove"


def test_a_daemon_whose_reply_cannot_be_read_is_queried_once_a_second_and_reported_once(
    world: World,
) -> None:
    world.daemon(zenoh.SampleKind.DELETE)
    world.passes(1.0)
    world.during_query = fail
    world.daemon(zenoh.SampleKind.PUT)
    world.passes(10.0)
    assert 5 <= world.queries <= 11
    assert world.printed == world.server.shown == [GONE, str(UNREADABLE)]
    world.during_query = lambda: None
    world.passes(2.0)
    assert world.printed == [GONE, str(UNREADABLE), BACK]
    assert world.server.shown[2:] == ["without daemon", BACK]


def test_a_daemon_that_ends_after_an_unreadable_reply_is_reported_as_gone(world: World) -> None:
    world.during_query = fail
    world.restart()
    world.passes(1.0)
    world.daemon(zenoh.SampleKind.DELETE)
    world.passes(1.0)
    assert world.server.shown == [str(UNREADABLE), GONE]


def test_the_facts_are_learned_after_a_restart_that_falls_into_one_round(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forward() -> None:
        monkeypatch.setattr(world.bridge._relay, "forward", usual)
        world.restart()

    before_s, usual = world.known_timeout_s, world.bridge._relay.forward
    monkeypatch.setattr(world.bridge._relay, "forward", forward)
    world.passes(1.0)
    assert world.known_timeout_s == before_s + 1.0
    assert world.server.shown == [BACK]


def test_the_facts_are_learned_again_if_the_daemon_restarts_while_it_is_queried(
    world: World,
) -> None:
    def restart_once() -> None:
        world.during_query = lambda: None
        world.restart()

    before_s = world.known_timeout_s
    world.during_query = restart_once
    world.restart()
    world.passes(1.0)
    assert world.queries == 2
    assert world.known_timeout_s == before_s + 2.0


def test_a_change_that_the_daemon_does_not_answer_does_not_delay_the_topics(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    gave_up, rounds = threading.Event(), list[bool]()

    def unanswered(_: object) -> None:
        assert gave_up.wait(10.0), "the bridge waits for the daemon"
        raise NoAnswerError("no answer")

    monkeypatch.setattr(world.bridge._robot, "set", unanswered)
    monkeypatch.setattr(world.bridge._relay, "forward", lambda: rounds.append(gave_up.is_set()))
    for _ in range(2):
        world.bridge._settings.set({"limits.linear_speed": 1.0})
    world.passes(3.0)
    assert len(rounds) >= 6
    assert not any(rounds)
    gave_up.set()
    begun = time.monotonic()
    while not world.printed and time.monotonic() - begun < 10.0:
        world.passes(0.5)
    assert world.printed == ["not set: no answer"]


class StartingWorld(World):
    """A world whose daemon restarts during the first query of the bridge."""

    restarted = False

    def _learn(self, robot: Client) -> Facts:
        facts = super()._learn(robot)
        if not self.restarted:
            self.restarted = True
            self.restart()
        return facts


def test_a_restart_of_the_daemon_while_the_bridge_starts_is_noticed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = StartingWorld(monkeypatch)
    before_s = world.known_timeout_s
    world.passes(1.0)
    assert world.known_timeout_s == before_s + 1.0
    assert world.queries == 1
