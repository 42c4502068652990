"""The Foxglove bridge follows its robot over restarts, and makes one log line of each event."""

from __future__ import annotations

import json
import os
import socket
import sys
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import pytest
import zenoh
from foxglove import Context
from msgspec.structs import replace

from acsard.bus.address import Address
from acsard.client import connection
from acsard.client.connection import Connection
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config, RosConfig
from acsard.core.messages.schema import (
    Events,
    LogEvent,
    ServiceReply,
    Time,
)
from acsard.core.messages.signature import public_name
from acsard.core.ros.names import full_name
from acsard.core.values import NS_PER_S, Role
from acsard.foxglove import bridge as module
from acsard.foxglove.bridge import Bridge
from acsard.foxglove.bridge import configuration as module_configuration
from acsard.foxglove.relay import EventDeduplicator
from acsard.foxglove.server import ShownTopics, start, stop_service
from acsard.host import clock
from acsard.host.errors import InUseError, NoAnswerError, NotPermittedError, ReplyError
from tests.each import each
from tests.unit.screens import STATE, raw_sample, sample_of

UNREADABLE = ReplyError("cannot read the robot's state; use the same version here")

GONE = "the daemon of robot acsar is gone; `acsard foxglove` waits for it"
BACK = "the daemon of robot acsar is back"


class Server:
    """The server's messages to its viewers."""

    def __init__(self) -> None:
        self.shown: list[str] = []

    def publish_status(self, text: str, level: object, status_id: str) -> None:
        self.shown.append(text)

    def remove_status(self, status_ids: list[str]) -> None:
        self.shown.append(f"without {status_ids[0]}")


class World:
    """A bridge in virtual time, whose daemon restarts when the test says so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns, self.queries = 100 * NS_PER_S, 0
        self.config = Config()
        self.during_query: Callable[[], object] = lambda: None
        self.printed: list[str] = []
        self.server = Server()
        monkeypatch.setattr(clock, "mono_ns", lambda: self.now_ns)
        monkeypatch.setattr(module, "configuration", self._configuration)
        monkeypatch.setattr(module, "start", lambda *_, **__: self.server)
        session: Any = SimpleNamespace(liveliness=lambda: self, zid=lambda: "0123456789abcdef")
        self.bridge = Bridge(Connection(session, "acsar", "app"), ("", 0), self.printed.append)
        self.queries = 0

    def declare_subscriber(self, key: str, take: Callable[[Any], None], *, history: bool) -> None:
        self._take = take

    def _configuration(self, robot: Connection) -> Config:
        config, self.queries = self.config, self.queries + 1
        self.during_query()
        return config

    def daemon(self, kind: zenoh.SampleKind) -> None:
        """Let the daemon start (PUT) or end (DELETE)."""
        self._take(SimpleNamespace(kind=kind))

    def restart(self) -> None:
        """Restart the daemon with another namespace."""
        self.daemon(zenoh.SampleKind.DELETE)
        self.config = replace(self.config, ros=RosConfig(namespace=f"{self.namespace}x"))
        self.daemon(zenoh.SampleKind.PUT)

    @property
    def namespace(self) -> str:
        return self.config.ros.namespace

    def passes(self, seconds: float) -> None:
        """Run the bridge for this time, in rounds with the pauses of its main loop."""
        end_ns = self.now_ns + seconds * NS_PER_S
        while self.now_ns < end_ns:
            self.now_ns += round((0.015 if self.bridge._wake.is_set() else 0.5) * NS_PER_S)
            self.bridge._wake.clear()
            self.bridge._round()

    def offers(self, namespace: str) -> bool:
        return full_name(namespace, "odom") in self.bridge._relay._outs


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


def fail() -> None:
    raise UNREADABLE


def test_the_log_has_a_viewer_s_call_under_a_readable_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The daemon replaces each comma in a name by a question mark."""
    monkeypatch.setattr(connection, "own_name", lambda: "alice@laptop acsard")
    robot = World(monkeypatch).bridge._robot
    name, _, _ = public_name(robot.caller).rpartition("/")
    assert name == "alice@laptop acsard foxglove"


@each(("key", "again"), [("diagnostics", 1), ("tf_static", 1), ("state", 1), ("odom", 0)])
def test_a_late_viewer_gets_the_last_message_of_a_rare_key(
    world: World, key: str, again: int
) -> None:
    relay = world.bridge._relay
    logged: list[bytes] = []
    topic = full_name(world.namespace, key)
    monitor: Any = SimpleNamespace(undeclare=lambda: None)
    relay._followed[key] = monitor
    out = relay._outs[topic]
    out.last = b"the last one"
    out.channel = cast("Any", SimpleNamespace(log=logged.append))
    relay.follow({topic}, set())
    assert logged == []
    relay.follow({topic}, {topic, "/topic_of_an_earlier_namespace"})
    assert logged == [b"the last one"] * again
    out.last = None  # nothing has arrived yet
    relay.follow({topic}, {topic})
    assert logged == [b"the last one"] * again


def test_a_late_viewer_of_the_log_gets_the_last_events_too(world: World) -> None:
    relay, answers, logged = world.bridge._relay, deque[Any](), list[bytes]()
    topic = full_name(world.namespace, "log")
    stream: Any = SimpleNamespace(
        put=answers.append,
        try_recv=lambda: answers.popleft() if answers else None,
        undeclare=lambda: None,
    )
    relay._followed["events"] = stream
    relay._robot.start_query = lambda key, take: take(sample_of(events(3)))  # type: ignore[method-assign, assignment]
    relay._outs[topic].channel = cast("Any", SimpleNamespace(log=logged.append))
    for viewers in (1, 2):
        relay.follow({topic}, {topic})
        relay.forward()
        assert len(logged) == 3 * viewers
    relay.follow({topic}, set())
    answers.extend([raw_sample(b"{"), sample_of(events(4))])
    relay.forward()
    assert len(logged) == 7
    assert b"mode3" in logged[-1]


def test_a_topic_that_a_viewer_opens_is_followed_queried_and_forwarded(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    relay, queried, woken = world.bridge._relay, list[str](), list[object]()
    queue = deque[Any]([raw_sample(b"{"), *[sample_of(STATE)] * 150, None])
    stream: Any = SimpleNamespace(
        try_recv=queue.popleft, put=None, wakes=woken.append, undeclare=lambda: None
    )
    monkeypatch.setattr(relay._robot, "subscribe", lambda key: stream)
    monkeypatch.setattr(relay._robot, "start_query", lambda key, take: queried.append(key))
    for key, is_queried in (("state", True), ("tf_static", False)):  # Zenoh repeats the latter
        queried.clear()
        logged = list[bytes]()
        topic = full_name(world.namespace, key)
        relay._outs[topic].channel = cast("Any", SimpleNamespace(log=logged.append))
        relay.follow({topic}, {topic})
        assert queried == ["state"] * is_queried
        if key == "state":
            relay.forward()
            assert len(logged) == 100, "the newest of a round"
    assert woken == [world.bridge._wake.set] * 2


def test_a_session_that_closes_does_not_end_a_round(world: World) -> None:
    relay = world.bridge._relay
    stream: Any = SimpleNamespace(try_recv=Mock(side_effect=zenoh.ZError("closed")))
    relay._followed["odom"] = stream
    relay.forward()


def test_the_end_of_the_bridge_waits_for_the_server_but_not_for_ever(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    released, stopped = Event(), Event()

    def stop() -> None:
        stopped.set()
        released.wait(20.0)

    world.bridge._server = cast(Any, SimpleNamespace(stop=stop))
    monkeypatch.setattr(module, "STOP_TIMEOUT_S", 0.01)
    world.bridge.close()
    assert stopped.wait(20.0)
    released.set()


def test_a_topic_that_no_viewer_shows_is_no_longer_followed(world: World) -> None:
    relay, ended = world.bridge._relay, list[str]()
    for key in ("odom", "state"):
        stream: Any = SimpleNamespace(undeclare=partial(ended.append, key))
        relay._followed[key] = stream
    relay.follow({full_name(world.namespace, "odom")}, set())
    assert ended == ["state"]
    assert list(relay._followed) == ["odom"]


@each(("namespace", "name"), [("", "/acsard/stop"), ("robot1", "/robot1/acsard/stop")])
@each("error", [None, NoAnswerError("nobody answers")])
def test_the_service_that_stops_the_robot_answers_also_without_a_robot(
    namespace: str, name: str, error: Exception | None
) -> None:
    robot: Any = Mock(call=Mock(return_value=ServiceReply(True, "stopped"), side_effect=error))
    service = stop_service(robot, RosConfig(namespace=namespace))
    assert service.name == name
    request, response = service.schema.request, service.schema.response
    assert request is not None
    assert response is not None
    assert request.schema.name == "std_srvs/srv/Trigger_Request"
    assert {"success", "message"} <= json.loads(response.schema.data)["properties"].keys()
    reply = json.loads(service.handler(cast(Any, None)))
    robot.call.assert_called_once_with("stop")
    assert (reply["success"], reply["message"]) == (
        (True, "stopped") if error is None else (False, "nobody answers")
    )


class Asked:
    """A robot behind TLS, or on this machine, that answers a client of this role."""

    def __init__(self, tls: str, role: Role, tables: object) -> None:
        self.where, self._role, self._tables = Address("tls/r:7449", "acsar", tls), role, tables

    def whoami(self) -> Any:
        return SimpleNamespace(role=self._role)

    def get(self, key: str) -> object:
        assert (key, self._role) != ("config", "viewer") or not self.where.tls
        return self._tables


TABLES = effective(Config(ros=RosConfig(namespace="robot1")))


@each(
    ("tls", "role", "namespace"),
    [("tls", "viewer", ""), ("tls", "maintainer", "robot1"), ("", "viewer", "robot1")],
)
def test_the_namespace_of_a_robot_is_used_if_this_program_may_read_it(
    tls: str, role: Role, namespace: str
) -> None:
    asked: Any = Asked(tls, role, TABLES)
    assert module_configuration(asked).ros.namespace == namespace


def test_a_configuration_of_another_version_is_refused_with_the_remedy() -> None:
    asked: Any = Asked("", "maintainer", {"ros": {"namespace": 5}})
    with pytest.raises(ReplyError, match="is the daemon a different version"):
        module_configuration(asked)


def test_a_topic_is_shown_until_its_last_viewer_has_gone() -> None:
    shown, channel = ShownTopics(lambda: None), cast(Any, SimpleNamespace(topic="/odom"))
    first, second = (cast(Any, SimpleNamespace(id=number)) for number in (1, 2))
    for client in (first, second):
        shown.on_subscribe(client, channel)
        assert shown.take() == ({"/odom"}, {"/odom"})
    shown.on_unsubscribe(first, channel)
    assert shown.take() == ({"/odom"}, set())
    shown.on_unsubscribe(second, channel)
    assert shown.take() == (set(), set())


def plain_ports_begin() -> int:
    return int(Path("/proc/sys/net/ipv4/ip_unprivileged_port_start").read_text())


@pytest.mark.skipif(plain_ports_begin() < 2, reason="each user may use each port here")
def test_a_port_that_needs_root_is_refused_with_another_one() -> None:
    robot: Any = SimpleNamespace(where=Address("tcp/127.0.0.1:1", "acsar", ""))
    port, user = plain_ports_begin() - 1, os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        with pytest.raises(
            NotPermittedError, match=r"use a port above 1023: --address 127\.0\.0\.1:1024"
        ):
            start(robot, RosConfig(), ("127.0.0.1", port), ShownTopics(lambda: None), Context())
    finally:
        os.seteuid(user)


def test_a_port_of_another_viewer_is_refused_with_another_one() -> None:
    robot: Any = SimpleNamespace(where=Address("tcp/127.0.0.1:1", "acsar", ""))
    with socket.create_server(("127.0.0.1", 0)) as other:
        at = ("127.0.0.1", other.getsockname()[1])
        with pytest.raises(InUseError, match=rf"cannot listen on .*:{at[1]}: .* --address "):
            start(robot, RosConfig(), at, ShownTopics(lambda: None), Context())


def test_each_end_of_the_daemon_is_reported_and_its_first_start_is_not(world: World) -> None:
    world.daemon(zenoh.SampleKind.PUT)
    world.passes(1.0)
    assert (world.printed, world.queries) == ([], 0)
    for _ in range(2):
        world.daemon(zenoh.SampleKind.DELETE)
        world.passes(1.0)
        world.daemon(zenoh.SampleKind.PUT)
        world.passes(3.0)
    assert world.printed == [GONE, BACK] * 2
    assert world.server.shown == [GONE, "without daemon"] * 2


def test_an_unreadable_daemon_is_queried_once_a_second_and_reported_once(
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
    assert world.server.shown[2:] == ["without daemon"]


def test_the_configuration_is_read_again_if_the_daemon_restarts_meanwhile(
    world: World,
) -> None:
    def restart_once() -> None:
        world.during_query = lambda: None
        world.restart()

    world.during_query = restart_once
    world.restart()
    world.passes(1.0)
    assert world.queries == 2
    assert world.offers("xx")


def test_a_viewer_that_comes_while_the_daemon_is_gone_is_told(world: World) -> None:
    rounds: list[Any] = []
    forwarded = list[bool]()
    world.bridge._relay.forward = lambda: forwarded.append(True)  # type: ignore[method-assign]
    channel = cast(Any, SimpleNamespace(topic="/odom"))
    world.bridge._relay.follow = lambda *topics: rounds.append(topics)  # type: ignore[method-assign]
    for number, shown in ((1, []), (2, [GONE, GONE])):
        world.bridge._shown_topics.on_subscribe(cast(Any, SimpleNamespace(id=number)), channel)
        world.passes(1.0)
        assert world.server.shown == shown
        world.daemon(zenoh.SampleKind.DELETE)
        world.passes(1.0)
    assert [fresh for _, fresh in rounds if fresh] == [{"/odom"}] * 2
    assert all(topics == {"/odom"} for topics, _ in rounds)
    assert len(forwarded) == len(rounds)


def test_the_bridge_makes_rounds_until_its_end(world: World) -> None:
    rounds = 0

    def make_round() -> None:
        nonlocal rounds
        rounds += 1
        if rounds < 3:
            world.bridge._wake.set()
        else:
            world.bridge.end()

    world.bridge._round = make_round  # type: ignore[method-assign]
    world.bridge._wake.set()
    world.bridge.run()
    assert rounds == 3


@pytest.mark.timeout(20)
def test_two_signals_end_the_bridge(monkeypatch: pytest.MonkeyPatch) -> None:
    # `timeout` and a closing terminal send two. The second one may interrupt the handler of the
    # first one at any call or return.
    for moment in range(20):
        bridge, passed = World(monkeypatch).bridge, 0

        def interrupt(*_: object, bridge: Bridge = bridge, moment: int = moment) -> None:
            nonlocal passed
            passed += 1
            if passed == moment:
                bridge.end()

        sys.setprofile(interrupt)
        try:
            bridge.end()
        finally:
            sys.setprofile(None)
        bridge.run()


def events(total: int, of: str = "first") -> Events:
    """Return the daemon's recent events after this many events have happened."""
    numbers = range(max(0, total - 20), total)
    log_events = [LogEvent(Time(n), f"mode{n}", "warning", f"{of} {n}", "ann", 1) for n in numbers]
    return Events(Time(total), total, log_events)


def names(deduplicator: EventDeduplicator, report: Events) -> list[str]:
    return [line.name for line in deduplicator.of(report)]


@each(("before", "now"), [(3, 4), (3, 3), (0, 5), (19, 23), (40, 60), (40, 55), (10, 100)])
def test_each_event_is_reported_once(before: int, now: int) -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(before))
    stored = range(max(before, now - 20), now)
    assert names(deduplicator, events(now)) == [f"mode{n}" for n in stored]


def test_an_event_that_lasts_is_reported_once_although_it_counts_several_times() -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(3))
    assert names(deduplicator, replace(events(3), stamp=Time(5), total=6)) == []


def test_an_answer_older_than_the_last_message_reports_no_event() -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(10))
    assert names(deduplicator, events(9)) == []
    assert names(deduplicator, events(11)) == ["mode10"]


def test_a_daemon_that_has_logged_as_much_since_its_restart_is_recognized_by_the_times() -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(10))
    later = [replace(event, stamp=Time(50)) for event in events(10, "second").events]
    assert len(deduplicator.of(replace(events(10), stamp=Time(60), events=later))) == 10


def test_a_restarted_daemon_s_events_are_reported_from_the_first() -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(10))
    later = replace(events(2, "second"), stamp=Time(11))
    assert names(deduplicator, later) == ["mode0", "mode1"]
