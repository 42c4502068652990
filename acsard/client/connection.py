"""The connection to one robot: queries, service calls, subscriptions and signed commands.

`Client` and `AsyncClient` show a program what it needs of it; the tools use it directly. Each
method blocks the calling thread until it has finished.
"""

from __future__ import annotations

import atexit
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from functools import cached_property
from typing import Any

import msgspec
import zenoh

from acsard.bus.address import Address
from acsard.bus.robot_discovery import NO_BATTERY, explain_silence, presence
from acsard.bus.subscription import Subscription, encoded
from acsard.bus.tls_files import shown_at
from acsard.bus.zenoh_sessions import client_session
from acsard.client.driving import UnheardError, repeat_zeros
from acsard.client.identity import ClientIdentity, identity
from acsard.client.reads import Reads
from acsard.client.ride import MAX_SOURCE_TIMEOUT_S, SEND_PERIOD_S
from acsard.client.signing import Beats, CommandSigner
from acsard.core.messages import schema
from acsard.core.messages.encodings import (
    DecodeError,
    Decoder,
    encode,
    encoding_name,
)
from acsard.core.messages.keys_and_roles import (
    BEAT,
    VERBS,
    by_key,
    command_key,
    full_key,
    is_service,
    key_hint,
    service_key,
    unknown,
)
from acsard.core.messages.permissions import COMMAND_ROLE, has
from acsard.core.messages.refusals import (
    BUSY_ENCODING,
    invalid_call,
    not_offered,
    require_size,
)
from acsard.core.messages.signature import Signature, public_name
from acsard.core.values import Plain, Pose
from acsard.host import clock
from acsard.host.errors import (
    MendableError,
    NoAnswerError,
    NotDrivenError,
    NotPermittedError,
    ReplyError,
    UnreachableError,
    UsageError,
)
from acsard.host.own_identity import new_secret, own_name, sender_id

REPLY_TIMEOUT_S = 3.0

MIN_SPACING_S = 0.003  # on one connection: the daemon drops commands above 1000 per second

# Zenoh's error reply to a query that reached the other side but was not answered in time.
TIMED_OUT = "Timeout"


@contextmanager
def open_connection(where: Address, source: str = "app") -> Iterator[Connection]:
    """Yield a connection that is ended at the end of the `with` block."""
    try:
        session = client_session(where.endpoint, where.tls)
    except UnreachableError as error:
        text = "; ".join(filter(None, (str(error), where.advice)))
        raise UnreachableError(text, error.why) from None
    connection = Connection(session, where.robot_id, source, where.tls, where.endpoint)
    end_at_exit(connection)
    try:
        yield connection
    finally:
        connection.end()


# Open connections, with the process and the thread that opened each.
_open: dict[Connection, tuple[int, threading.Thread]] = {}


def end_at_exit(client: Connection) -> None:
    """End a connection when the program ends, unless `Connection.end` was called.

    A thread of Zenoh or one that waits for messages could block or abort Python's end.
    """
    _open[client] = os.getpid(), threading.current_thread()


def _end_all() -> None:
    # The threads of a connection do not exist in a forked child. Python waits for a thread that is
    # neither the main thread nor a daemon, so such a thread ends its connections itself.
    main, pid = threading.main_thread(), os.getpid()
    _end(
        [
            client
            for client, (opened_pid, thread) in list(_open.items())
            if opened_pid == pid and (thread is main or thread.daemon or not thread.is_alive())
        ]
    )


# Python waits for all threads before it calls the functions of `atexit`, and the threads of an open
# subscription do not end. The functions of `threading._register_atexit` are called before the wait.
getattr(threading, "_register_atexit", atexit.register)(_end_all)
atexit.register(_end_all)


def _end(clients: Sequence[Connection]) -> None:
    # First stop each robot that may still follow them.
    now, ends = clock.steady_s(), []
    for client in clients:
        _open.pop(client, None)
        for sender, at_s in client._spacing.end():
            # After the longest timeout, the robot no longer follows the sender, so a zero would
            # only stop the next sender.
            if now - at_s < MAX_SOURCE_TIMEOUT_S:
                ends.append(repeat_zeros(sender, at_s))
    try:
        while ends := [zeros for zeros in ends if next(zeros, None) is not None]:
            time.sleep(SEND_PERIOD_S)
    finally:
        for client in clients:
            close(client.session)


def close(session: zenoh.Session) -> None:
    """Close a Zenoh session, even if the other side does not respond."""
    try:
        session.close()
    except zenoh.ZError:
        pass


class _CommandSpacing:
    # The daemon drops commands above 1000 a second per connection and key, and so would drop a zero
    # directly after another one.
    def __init__(self) -> None:
        # The lock is reentrant: a signal handler may also send while the same thread holds it.
        self._lock, self._next_s, self._last_s = threading.RLock(), 0.0, 0.0
        self.moving: dict[Connection, float] = {}  # time of the last speed, s
        self.ending = False  # only zeros may be sent

    def end(self) -> list[tuple[Connection, float]]:
        """Permit only zeros from now on, and return `moving`."""
        with self._lock:
            self.ending = True
            return list(self.moving.items())

    @contextmanager
    def wait(self) -> Iterator[None]:
        """Wait until the next command may be sent, which the `with` block does."""
        # Each thread reserves a time and waits for it without the lock. Otherwise a thread that
        # sends without end would take the lock again and again before the others.
        with self._lock:
            at_s = max(self._next_s, time.monotonic())
            self._next_s = at_s + MIN_SPACING_S
        time.sleep(max(0.0, at_s - time.monotonic()))
        with self._lock:
            # A busy machine may wake another thread late, or a signal handler may just have sent.
            while (left_s := self._last_s + MIN_SPACING_S - time.monotonic()) > 0:
                time.sleep(left_s)
            yield
            self._last_s = time.monotonic()
            self._next_s = max(self._next_s, self._last_s + MIN_SPACING_S)


def accepted(reply: schema.ServiceReply) -> schema.ServiceReply:
    """Return the reply. Raises `ReplyError` if it is a refusal: a program must not miss it."""
    if not reply.success:
        raise ReplyError(reply.message)
    return reply


class Connection(Reads):
    """The connection of a tool or a `Client` to one robot, with all keys."""

    def __init__(
        self,
        session: zenoh.Session,
        robot_id: str,
        source: str = "app",
        tls: str = "",
        endpoint: str = "",
    ) -> None:
        self.session, self.source = session, source
        self.where = Address(endpoint, robot_id, tls)
        self.name = own_name()  # in the daemon's log of service calls; you may change it
        self._opened = False
        self._spacing = _CommandSpacing()
        self.certificate = shown_at(endpoint, tls)  # common name that the daemon sees
        # The secret identifies this program as a caller of services. Clients made by `sibling`
        # share it, although they may send commands under another name.
        self._secret = new_secret()
        whole = sender_id(self.name)
        self._sender, self._sender_id = CommandSigner(whole), whole
        self._beats = Beats(session, self.key(BEAT))
        self._own_causes: set[int] = set()  # that calls of this client have latched

    @cached_property
    def sender(self) -> str:
        """The public name of this client as a sender: `state.sender` while it drives."""
        return public_name(self._sender_id, self.certificate)

    @property
    def caller(self) -> str:
        """The sender id, `NAME/SECRET`, in this client's service calls and queries.

        The daemon's log shows a public name without the secret.
        """
        return sender_id(self.name, self._secret)

    def sibling(self, robot_id: str) -> Connection:
        """Return a client of a robot on the same connection, which is a separate sender."""
        other = Connection(self.session, robot_id, self.source, self.where.tls, self.where.endpoint)
        other.name, other._secret, other._spacing = self.name, self._secret, self._spacing
        return other

    def named(self, name: str) -> Connection:
        """Return this client under another name in the daemon's log of service calls."""
        other = copy(self)
        other.name = name
        return other

    def key(self, name: str) -> str:
        """Return the full Zenoh key for a key of the topic table, such as "odom"."""
        return full_key(self.where.robot_id, name)

    def command_key(self, source: str) -> str:
        """Return the key, without the robot's id, on which this client sends commands as `source`.

        Over TLS, the key ends with the common name of this client's certificate.
        """
        return command_key("cmd", source, self.certificate)

    def send(self, linear: float, angular: float = 0.0) -> None:
        """Send one command, as `Client.send` does."""
        # The echo shows how old the wish is, so copy the beat before the command waits.
        echo = self._beats.newest()
        if echo is None:
            return
        with self._spacing.wait():
            if self._opened:
                self._put(linear, angular, echo)
            else:
                self._opened = True
                self._put(0.0, 0.0, echo)

    def end(self) -> None:
        """Close the connection, as `connect` does at the end of its `with` block.

        First stop each robot that may still follow: without a zero, it would drive on until the
        source's timeout, up to 10 s. From now on, other threads can send only zeros.
        """
        _end([self])

    def call(self, service: str, **fields: object) -> schema.ServiceReply:
        """Call a service, such as "stop", and return its reply, also a refusal."""
        if service in ("clear", "activate") and "numbers" not in fields:
            fields["numbers"] = self._present_causes()
        reply = self.request(service, fields)
        self._own_causes.update(reply.data.numbers)
        return reply

    def _present_causes(self) -> list[int]:
        # Those of this moment: the answer may already have a stop that came after the call. Of a
        # cause that an earlier call has latched, this client knows that it is older.
        asked_s = clock.steady_s()
        causes = self.get("state").causes
        waited_s = clock.steady_s() - asked_s
        return [
            cause.number
            for cause in causes
            if cause.number in self._own_causes or (cause.age or 0.0) >= waited_s
        ]

    def set(self, settings: Mapping[str, Plain]) -> schema.ServiceReply:
        """Change settings of the daemon, and return its reply, also a refusal."""
        return self.request("set", {"settings": settings})

    def _offered(self) -> dict[str, list[str]]:
        # A daemon of another version refuses a service, and a field of a payload, that it lacks.
        services: dict[str, list[str]] = self.get("info").services
        return services

    def request(self, service: str, fields: Mapping[str, object]) -> schema.ServiceReply:
        """Call the service `service` with `fields` as its payload, and return its reply.

        Unlike `call`, this method does not add the field `numbers`. A payload that is too large for
        the daemon is not sent, because the bus may drop it. Instead, this method returns the
        refusal that the daemon would send.
        """
        payload, key = msgspec.json.encode(fields) if fields else None, service_key(service)
        if payload is not None and (verb := VERBS.get(key)) is not None:
            try:
                require_size(verb, payload)
            except DecodeError as error:
                return invalid_call(verb, error)
        return Decoder(schema.ServiceReply).decode(*self.reply(key, payload))

    def _reply(self, name: str) -> tuple[str, bytes]:
        return self.reply(name)

    def _subscribe(self, name: str) -> Subscription:
        return self.subscribe(name)

    def reply(self, name: str, payload: bytes | None = None) -> tuple[str, bytes]:
        """Return the last message on a key, not decoded, as a pair of encoding and payload.

        For the key of a service, call this service with the arguments in `payload`, and return its
        reply.
        """
        # Ignore later replies, because any client on the bus may send any number of replies.
        end_s = time.monotonic() + REPLY_TIMEOUT_S
        while True:
            reply = self._first(name, payload)
            if reply is None:
                raise self._unanswered(name)
            if reply.ok is not None:
                return encoded(reply.ok)
            error_text = encoding = ""
            if reply.err is not None:
                error_text = reply.err.payload.to_bytes().decode(errors="replace")
                encoding = str(reply.err.encoding)
            if error_text == TIMED_OUT:
                raise NoAnswerError(
                    f"no answer on the Zenoh key {self.key(name)} within {REPLY_TIMEOUT_S:g} s: "
                    "the daemon or the network is stuck; try again, or run `acsard doctor` on the "
                    "robot"
                )
            # Repeat a query, but not a service call: since the first attempt, another client may
            # have called a service with the opposite effect.
            if encoding != BUSY_ENCODING or is_service(name) or time.monotonic() > end_s:
                raise ReplyError(f"{name}: {error_text}")
            time.sleep(0.03)

    def whoami(self) -> ClientIdentity:
        """Return this client's role and name at the robot. The role is "" if it is unknown."""
        where = self.where
        try:
            return identity(
                self.start_query, where.tls, self.sender, where.robot_id, where.endpoint
            )
        except zenoh.ZError:
            raise self._refused("whoami") from None

    def pose(self) -> Pose:
        """Return the present pose of the robot in the odom frame, m and rad."""
        state = self.get("state")
        return Pose(state.x, state.y, state.yaw)

    def samples(self, name: str, look: Callable[[float], None]) -> Iterator[zenoh.Sample]:
        """Yield samples of a key or wildcard, as `Subscription.until_silence` does."""
        yield from self._subscription(name, exact=False).until_silence(None, look)

    def listen(self, name: str, callback: Callable[[zenoh.Sample], None]) -> Any:
        """Subscribe to a key. A thread of Zenoh calls `callback` with each sample.

        To end the subscription, call `undeclare` on the returned subscriber.
        """
        try:
            return self.session.declare_subscriber(self.key(name), callback)
        except zenoh.ZError:
            raise self._refused(name) from None

    def subscribe(self, name: str) -> Subscription:
        """Subscribe to a key. Return the subscription, a queue of samples that are not decoded.

        A caller can read the queue without waiting.
        """
        return self._subscription(name, exact=True)

    def start_query(self, name: str, take: Callable[[zenoh.Sample], object]) -> None:
        """Query a key, and return immediately. A thread of Zenoh calls `take` with each reply.

        Error replies are ignored.
        """
        self.session.get(
            self.key(name),
            lambda reply: take(reply.ok) if reply.ok is not None else None,
            timeout=REPLY_TIMEOUT_S,
        )

    def _subscription(self, name: str, *, exact: bool) -> Subscription:
        topic = by_key(name)
        latched = topic is not None and topic.latched
        try:
            return Subscription(self.session, self.key(name), latched=latched, exact=exact)
        except zenoh.ZError:
            raise self._refused(name) from None

    def put(self, twist: schema.Twist, signature: Signature, source: str = "") -> None:
        """Forward a command of another sender, for example of a person who uses a web page.

        Args:
            twist: the command.
            signature: the identity of the other sender, and the echo and the stamp of the command.
            source: the command source on which the command is sent; "" for the source of this
                client.
        """
        with self._spacing.wait():
            self._publish(twist, signature, source or self.source)

    def _publish(self, twist: schema.Twist, signature: Signature, source: str) -> None:
        self.session.put(
            self.key(self.command_key(source)),
            encode(twist, "msgpack"),
            encoding=encoding_name("msgpack", "Twist"),
            express=True,
            attachment=signature.pack(),
        )

    def _put(self, linear: float, angular: float, echo: schema.Beat) -> None:
        if self._spacing.ending and (linear or angular):
            raise NoAnswerError("the connection to the daemon is being closed: connect again")
        twist = schema.Twist(schema.Vector3(x=linear), schema.Vector3(z=angular))
        self._publish(twist, self._sender.sign(None, echo), self.source)
        if linear or angular:
            self._spacing.moving[self] = clock.steady_s()
        else:
            self._spacing.moving.pop(self, None)

    def _first(self, name: str, payload: bytes | None) -> zenoh.Reply | None:
        try:
            replies = self.session.get(
                self.key(name),
                payload=payload,
                attachment=Signature(self.caller).pack(),
                timeout=REPLY_TIMEOUT_S,
            )
        except zenoh.ZError:
            raise self._refused(name) from None
        return next(iter(replies), None)

    def _refused(self, name: str) -> MendableError:
        if self.session.is_closed():
            return NoAnswerError(
                "the connection of this client is closed: use the client only inside the `with` "
                "block of `connect`"
            )
        return UsageError(f"{name!r} is not a key; `acsard topics` lists them")

    def _unanswered(self, name: str) -> MendableError:
        key, no_answer = name.partition("?")[0], f"no answer on the Zenoh key {self.key(name)}"
        if unknown(key):
            return NoAnswerError(f"{no_answer}: {key} is not in the topic table ({key_hint(key)})")
        if self.where.tls:
            us = self.whoami()
            if us.silence:
                return NoAnswerError(f"{no_answer}: {us.silence}")
            verb = key.removeprefix(service_key(""))
            if is_service(key) and verb not in (offered := self._offered()):
                return ReplyError(not_offered(verb, offered))
            if why := us.lacks(key):
                return NotPermittedError(why)
        where = self.where
        visibility = presence(self.session, where.robot_id, where.endpoint)
        if visibility is None or visibility.here or not where.endpoint:
            if key == "battery":
                return NoAnswerError(f"{no_answer}: {NO_BATTERY}")
            return NoAnswerError(
                f"{no_answer}; is the daemon of robot.id {where.robot_id!r} stuck, does it have "
                "this key (`acsard topics`), and may you query it (`acsard doctor`)?"
            )
        return NoAnswerError(
            f"{no_answer}: {explain_silence(key, where.robot_id, where.endpoint, visibility)}"
        )

    def explain_error(self, error: UnheardError | NoAnswerError) -> MendableError:
        """Return the error to raise instead, which names the role if that may be the cause."""
        if isinstance(error, UnheardError) and not self.where.tls:
            return NotDrivenError(str(error))
        if not self.where.tls:
            return error
        us = self.whoami()
        if us.silence:
            return NoAnswerError(f"{error}; {us.silence}")
        if isinstance(error, NoAnswerError):
            return error
        if not has(us.role, COMMAND_ROLE):
            return NotPermittedError(us.describe())
        # The role may explain why no command arrives, but not a fault or a stop.
        explains = error.lacks_only_commands
        return NotDrivenError(f"{error}; {us.describe()}" if explains else str(error))
