"""A connection and its clients without a bus: sent commands, calls and errors."""

from __future__ import annotations

import asyncio
import threading
import time
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import zenoh
from msgspec import structs

from acsard import client
from acsard.bus.robot_discovery import Presence
from acsard.client import AcsardError, Client, NoAnswerError, asynchronous, connection, driving
from acsard.client.asynchronous import AsyncClient
from acsard.client.connection import MIN_SPACING_S, Connection, accepted
from acsard.client.driving import UnheardError
from acsard.client.identity import ClientIdentity
from acsard.core.config.settings import Config, DriveConfig
from acsard.core.incoming.commands import Arrival, Receiver
from acsard.core.incoming.queries import Queries, Query
from acsard.core.messages import schema
from acsard.core.messages.encodings import Decoder, encode
from acsard.core.messages.refusals import BUSY_ENCODING, MAX_COMMAND_BYTES
from acsard.core.messages.schema import (
    Beat,
    ReplyData,
    ServiceReply,
)
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import REST, Command, Echo, Status
from acsard.host import clock
from acsard.host.errors import ReplyError
from tests.each import each

RECEIVER = Receiver(Config().joint_names, Kinematics(DriveConfig()))
BEAT = schema.Beat(7, 1000)
INFO = schema.Info("acsar", "1.2.3", 42, "sim", True, 100.0, [], [])


class Session:
    """A session that records each put as the daemon would receive it."""

    def __init__(self, zid: str) -> None:
        self._zid = zid
        self.heard: list[Command] = []
        self.closed = False

    def close(self) -> None:
        self.closed = True

    def is_closed(self) -> bool:
        return self.closed

    def declare_subscriber(self, key: str, take: Any) -> Any:
        if self.closed or not key.endswith("/beat"):
            raise zenoh.ZError("session closed")
        self.publish, self.beat_key = take, key
        self.beat(BEAT)
        return take

    def beat(self, beat: Beat) -> None:
        """Let a beat arrive at the client."""
        payload = SimpleNamespace(to_bytes=lambda: encode(beat, "msgpack"))
        self.publish(SimpleNamespace(encoding="", payload=payload, key_expr=self.beat_key))

    def zid(self) -> str:
        return self._zid

    def get(self, key: str, *_: Any, **__: Any) -> list[Any]:
        if self.closed:
            raise zenoh.ZError("session closed")
        return []  # no robot answers

    def put(self, key: str, payload: bytes, *, encoding: str, attachment: bytes, **_: Any) -> None:
        if self.closed:
            raise zenoh.ZError("session closed")
        key = key.removeprefix("acsard/acsar/")
        arrival = Arrival(key, True, payload, encoding, 0, None, "", attachment=attachment)
        self.heard.append(RECEIVER.command(arrival))


@pytest.fixture
def session() -> Session:
    return Session("0123456789abcdef")


def client_of(session: Session) -> Connection:
    fake: Any = session
    return Connection(fake, "acsar", "app")


def test_each_command_echoes_the_newest_beat_and_none_is_sent_before_the_first(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "beat", lambda _: None)
    client = client_of(session)
    client.send(0.5)
    assert session.heard == []
    monkeypatch.undo()
    for number in range(3):
        session.beat(Beat(BEAT.run, number))
        client.send(0.5)
    assert [command.echo for command in session.heard] == [
        Echo(BEAT.run, number * 1000) for number in range(3)
    ]
    assert [command.twist.linear for command in session.heard] == [0.0, 0.5, 0.5]
    assert [(command.sequence, command.sender) for command in session.heard] == [
        (number, client.sender) for number in (1, 2, 3)
    ]
    assert client_of(Session("fedcba9876543210")).sender != client.sender


def test_a_beat_that_is_not_the_robot_s_or_cannot_be_read_is_not_echoed(session: Session) -> None:
    client = client_of(session)
    client.send(0.0)
    forged = SimpleNamespace(to_bytes=lambda: encode(Beat(BEAT.run, 9), "msgpack"))
    for key, payload in (
        ("acsard/*/beat", forged),
        (session.beat_key, SimpleNamespace(to_bytes=lambda: b"{")),
    ):
        session.publish(SimpleNamespace(encoding="", payload=payload, key_expr=key))
        client.send(0.5)
    assert {command.echo for command in session.heard} == {Echo(BEAT.run, BEAT.boot_us * 1000)}


def test_the_commands_of_two_threads_leave_in_their_order_and_with_the_pause(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bus delays the speed of the first thread, and then a second thread sends a zero."""
    client, put, began = client_of(session), session.put, threading.Event()
    puts_s: list[float] = []

    def slow(key: str, payload: bytes, **rest: Any) -> None:
        if not began.is_set():
            began.set()
            time.sleep(10 * MIN_SPACING_S)
        put(key, payload, **rest)
        puts_s.append(time.monotonic())

    client.send(0.0)
    monkeypatch.setattr(session, "put", slow)
    thread = threading.Thread(target=client.send, args=(0.5,))
    thread.start()
    assert began.wait(5.0)
    client.send(0.0)
    thread.join()
    assert [command.sequence for command in session.heard] == [1, 2, 3]
    assert session.heard[-1].twist == REST
    assert puts_s[1] - puts_s[0] >= MIN_SPACING_S


def test_the_end_of_a_connection_sends_zeros_to_each_robot_that_may_still_move(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driving, "MAX_END_S", 0.12)
    robot = client_of(session)
    other = robot.sibling("acsar")
    resting = robot.sibling("acsar")
    for sender in (robot, other, resting):
        without_states(sender, monkeypatch)
        sender.send(0.0)
        sender.send(0.3)
    resting.send(0.0)
    sent = len(session.heard)
    robot.end()
    zeros = session.heard[sent:]
    assert {command.twist for command in zeros} == {REST}
    by = [command.sender for command in zeros]
    # No state shows that the robots stop, so the zeros are repeated.
    assert by[:2] == by[2:4]
    assert set(by) == {robot.sender, other.sender}
    assert session.closed


def test_while_a_connection_ends_other_threads_send_only_zeros(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = client_of(session)
    without_states(robot, monkeypatch)
    monkeypatch.setattr(driving, "MAX_END_S", 0.12)
    robot.send(0.0)
    robot.send(0.3)
    errors: list[str] = []

    def drive_on() -> None:
        try:
            while True:
                robot.send(0.3)
        except NoAnswerError as error:
            errors.append(str(error))

    thread = threading.Thread(target=drive_on)
    thread.start()
    robot.end()
    thread.join()
    assert session.heard[-1].twist == REST
    assert ["is being closed" in error for error in errors] == [True]


def test_each_method_reports_a_closed_connection(session: Session) -> None:
    robot = client_of(session)
    session.close()
    for method in (
        robot.pose,
        robot.whoami,
        lambda: robot.call("stop"),
        lambda: Client(robot).drive(0.1, seconds=1.0),
        lambda: next(robot.messages("odom")),
        lambda: robot.listen("odom", print),
    ):
        with pytest.raises(NoAnswerError, match="connection of this client is closed"):
            method()
    with pytest.raises(NoAnswerError, match="connection of this client is closed"):
        asyncio.run(AsyncClient(robot).get("odom"))


def without_states(robot: Connection, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the client subscribe to `state`, on which nothing arrives."""
    silence = SimpleNamespace(try_recv=lambda: None, undeclare=lambda: None)
    monkeypatch.setattr(robot, "subscribe", lambda _: silence)


@pytest.mark.parametrize("method", ["pose", "whoami", "call", "get", "set"])
async def test_an_async_call_that_takes_too_long_raises_a_documented_error(
    session: Session, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    robot, released = AsyncClient(client_of(session)), threading.Event()
    monkeypatch.setattr(asynchronous, "CALL_TIMEOUT_S", 0.05)
    monkeypatch.setattr(session, "get", lambda *_, **__: [released.wait(20.0)][:0])
    fields: dict[str, Any] = {"call": {"service": "stop"}, "get": {"name": "odom"}}
    fields["set"] = {"settings": {}}
    try:
        with pytest.raises(NoAnswerError, match="did not end within"):
            await getattr(robot, method)(**fields.get(method, {}))
    finally:
        released.set()


@pytest.mark.parametrize("name", ["odm", "statte"])
def test_an_unknown_key_is_reported_as_the_only_reason(session: Session, name: str) -> None:
    with pytest.raises(NoAnswerError) as raised:
        client_of(session).reply(name)
    message = str(raised.value)
    assert f"acsard/acsar/{name}" in message
    assert "did you mean" in message
    assert "daemon" not in message


def error(text: str, encoding: str = "text/plain") -> SimpleNamespace:
    """Return an error reply of Zenoh or of the daemon."""
    payload = SimpleNamespace(to_bytes=text.encode)
    return SimpleNamespace(ok=None, err=SimpleNamespace(payload=payload, encoding=encoding))


BUSY = error("busy", BUSY_ENCODING)
STUCK = (NoAnswerError, "within .* the daemon or the network is stuck")
REFUSED = (ReplyError, "no: because")


@each(
    ("name", "replies", "asked", "raised"),
    [
        ("odom", [error("Timeout")], 1, STUCK),
        ("srv/stop", [error("Timeout")], 1, STUCK),
        ("odom", [error("no: because")], 1, REFUSED),
        # A query that a busy daemon refused is repeated, and a call is not.
        ("odom", [BUSY, BUSY, error("no: because")], 3, REFUSED),
        ("srv/stop", [BUSY, error("no: because")], 1, (ReplyError, "srv/stop: busy")),
    ],
)
def test_an_error_reply_is_repeated_if_the_daemon_is_busy_and_named_otherwise(
    name: str, replies: list[Any], asked: int, raised: tuple[type[Exception], str]
) -> None:
    session, left = Session("0123456789abcdef"), iter(replies)
    vars(session)["get"] = lambda *_, **__: [next(left)]
    kind, words = raised
    with pytest.raises(kind, match=words):
        client_of(session).reply(name)
    assert len(list(left)) == len(replies) - asked


@each(
    ("key", "present", "words"),
    [
        ("battery", True, "battery has a value only while the board reports"),
        ("config", True, "is the daemon of robot.id 'acsar' stuck"),
        ("config", None, "is the daemon of robot.id 'acsar' stuck"),  # the session is closing
        ("config", False, "no daemon"),
        ("battery", False, "no daemon"),
    ],
)
def test_without_tls_a_silence_is_explained_by_what_the_bus_shows(
    key: str, present: bool | None, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    status = None if present is None else Presence(linked=True, here=present)
    monkeypatch.setattr(connection, "presence", lambda *_: status)
    ours = client_of(Session("0123456789abcdef"))
    ours.where = ours.where._replace(endpoint="tcp/127.0.0.1:1")
    with pytest.raises(NoAnswerError, match=words):
        ours.reply(key)


def test_only_a_good_answer_to_a_query_is_taken(session: Session) -> None:
    taken, queried = list[object](), list[Any]()
    vars(session)["get"] = lambda _, take, **__: queried.append(take)
    client_of(session).start_query("state", taken.append)
    for reply in (error("Timeout"), SimpleNamespace(ok="state", err=None)):
        queried[0](reply)
    assert taken == ["state"]


@each(
    ("identity", "words"),
    [
        (ClientIdentity("", "anna", "anna/1", "acsar"), "no daemon answers as 'acsar'"),
        (ClientIdentity("viewer", "anna", "anna/1", "acsar"), "anna has the role viewer"),
    ],
)
def test_over_tls_a_silence_is_explained_by_the_role_of_the_certificate(
    identity: ClientIdentity, words: str
) -> None:
    ours = client_of(Session("0123456789abcdef"))
    ours.where = ours.where._replace(tls="certificates")
    vars(ours)["whoami"] = lambda: identity
    with pytest.raises((NoAnswerError, client.NotPermittedError), match=words) as raised:
        ours.reply("config")
    assert isinstance(raised.value, NoAnswerError) is (identity.role == "")


def test_a_call_above_the_size_limit_is_refused_in_the_daemon_s_words(
    session: Session,
) -> None:
    """The bus does not carry a much larger payload, so the daemon could not refuse it."""
    session.close()  # each call that the client sends now raises an error
    empty = len(b'{"settings":{"limits.linear_speed":""}}')
    largest = {"limits.linear_speed": "x" * (MAX_COMMAND_BYTES - empty)}
    larger = {"limits.linear_speed": largest["limits.linear_speed"] + "x"}
    with pytest.raises(NoAnswerError):
        client_of(session).set(largest)
    payload = msgspec.json.encode({"settings": larger})
    query = Query(1, "srv/set", "srv/set", "", payload, "application/json")
    replies = Queries(Config(), INFO).serve(query, lambda _: None, 0, Status("", "booting", "", ""))
    assert isinstance(replies, list)
    (reply,) = replies
    refusal = Decoder(schema.ServiceReply).decode(reply.encoding, reply.payload)
    assert refusal.message.startswith("the payload has over 4096 bytes")
    assert client_of(session).set(larger) == refusal
    with pytest.raises(ReplyError, match="the payload has over 4096 bytes"):
        accepted(refusal)
    done = ServiceReply(True, "done")
    assert accepted(done) is done
    with pytest.raises(NoAnswerError):  # a stop is sent whatever its size
        client_of(session).request("stop", {"why": "x" * (MAX_COMMAND_BYTES + 1)})


def test_a_release_names_the_causes_that_are_older_than_the_call(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer on `state` takes 1 s, in which somebody else has stopped the robot again."""
    ours, sent, now_s = client_of(session), list[object](), 100.0

    def get(key: str) -> object:
        nonlocal now_s
        now_s += 1.0
        ages = {1: 5.0, 2: 1.0, 3: 0.99, 4: None}
        causes = [SimpleNamespace(number=number, age=age) for number, age in ages.items()]
        return {"state": SimpleNamespace(causes=causes)}[key]

    monkeypatch.setattr(clock, "steady_s", lambda: now_s)

    def request(service: str, fields: dict[str, object]) -> ServiceReply:
        sent.append(dict(fields))
        return ServiceReply(True, "done", ReplyData([3] if service == "stop" else []))

    monkeypatch.setattr(ours, "get", get)
    monkeypatch.setattr(ours, "request", request)
    ours.call("clear")
    ours.call("activate")
    ours.call("clear", numbers=[4])
    ours.call("stop")
    assert sent == [{"numbers": [1, 2]}, {"numbers": [1, 2]}, {"numbers": [4]}, {}]
    ours.call("clear")
    assert sent[-1] == {"numbers": [1, 2, 3]}, "this client has latched number 3 itself"


def test_over_tls_a_service_that_the_robot_does_not_have_is_refused_with_those_that_it_has(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = client_of(session)
    ours.where = ours.where._replace(tls="certificates")
    info = structs.replace(INFO, services={"stop": [], "dance": []})
    monkeypatch.setattr(ours, "whoami", lambda: ClientIdentity("viewer", "anna", "anna/1"))
    monkeypatch.setattr(ours, "get", {"info": info}.get)
    with pytest.raises(ReplyError, match="'danc' is not a service of this robot; did you mean dan"):
        ours.request("danc", {})
    with pytest.raises(client.NotPermittedError):
        ours.request("dance", {})


@each(
    ("tls", "silence", "words"),
    [
        ("", "nobody is there", "^nothing received$"),
        ("certificates", "", "^nothing received$"),
        ("certificates", "is anna listed?", "^nothing received; is anna listed\\?$"),
    ],
)
def test_the_error_of_a_silent_robot_names_the_certificate_if_that_may_be_the_reason(
    session: Session, monkeypatch: pytest.MonkeyPatch, tls: str, silence: str, words: str
) -> None:
    ours = client_of(session)
    ours.where = ours.where._replace(tls=tls)
    monkeypatch.setattr(ours, "whoami", lambda: SimpleNamespace(silence=silence))
    with pytest.raises(NoAnswerError, match=words):
        raise ours.explain_error(NoAnswerError("nothing received"))


@each(
    ("tls", "role", "lacks_only_commands", "kind", "words"),
    [
        ("", "operator", True, client.NotDrivenError, "why"),
        ("certificates", "operator", False, client.NotDrivenError, "why"),
        # Only if no command arrived, the role may be the reason.
        ("certificates", "operator", True, client.NotDrivenError, "anna has the role operator"),
        ("certificates", "viewer", False, client.NotPermittedError, "anna has the role viewer"),
    ],
)
def test_the_error_of_a_drive_names_the_role_if_it_may_be_the_reason(
    session: Session, monkeypatch: pytest.MonkeyPatch,
    tls: str, role: Any, lacks_only_commands: bool, kind: type[AcsardError], words: str,
) -> None:  # fmt: skip
    ours = client_of(session)
    ours.where = ours.where._replace(tls=tls)
    monkeypatch.setattr(ours, "whoami", lambda: ClientIdentity(role, "anna", "anna/1"))
    error = ours.explain_error(UnheardError("why", lacks_only_commands=lacks_only_commands))
    assert type(error) is kind
    assert words in str(error)
    assert ("role" in str(error)) == ("role" in words)
    assert kind.__name__ in client.__doc__.split()
