"""The client of scripts: each verb waits until it is done."""

from __future__ import annotations

import os
import platform
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from typing import Any

import msgspec
import zenoh

from acsard.bus.certificates import shown_at
from acsard.bus.fleet import around
from acsard.bus.identity import Identity, identity
from acsard.bus.quiet import why as why_quiet
from acsard.bus.subscription import Subscription, encoded, queue_on
from acsard.client.driving import UnheardError, drive
from acsard.host import clock
from acsard.host.errors import (
    MendableError,
    NoAnswerError,
    NotDrivenError,
    NotPermittedError,
    ReplyError,
    UsageError,
)
from acsard.host.own_name import new_secret, own_name, sender_id
from acsard.incoming.queries import BUSY
from acsard.messages import schema
from acsard.messages.encodings import Decoder, encode, encoding_name
from acsard.messages.signature import Signature, public_name
from acsard.messages.topics import (
    VERBS,
    by_key,
    command_key,
    full_key,
    key_hint,
    service_key,
    unknown,
)
from acsard.values import Plain, Pose

AGAIN_S = 0.03
"""Between a daemon that says it is asked too much and the next try."""

SPACING_S = 0.003
REPLY_TIMEOUT_S = 3.0

TIMED_OUT = "Timeout"
"""What Zenoh says in the place of one who heard the question and did not answer in time."""


class _Puts:
    """Of one connection: the daemon takes 1000 commands a second of it on a key, so a zero on the
    heels of another command, be it of somebody else who shares it, would be lost."""

    def __init__(self) -> None:
        # A signal's handler may send as well, while the same thread is in here.
        self._lock, self._next_s = threading.RLock(), 0.0

    def wait(self) -> None:
        """Until one may go."""
        with self._lock:
            at_s = max(self._next_s, time.monotonic())
            self._next_s = at_s + SPACING_S
        time.sleep(max(0.0, at_s - time.monotonic()))
        # A busy machine wakes it late: the next one is as far from that.
        self._next_s = max(self._next_s, time.monotonic() + SPACING_S)


class Client:
    """A connection to one robot; make it with `connect`."""

    def __init__(
        self,
        session: zenoh.Session,
        robot_id: str,
        source: str,
        tls: str = "",
        endpoint: str = "",
    ) -> None:
        self.session, self._tls, self._endpoint = session, tls, endpoint
        self._id, self.source = robot_id, source
        self.name = own_name()
        """Who calls services, in the daemon's log; set it to what you like."""
        self._opened = False
        self._puts = _Puts()
        self.certificate = shown_at(endpoint, tls)
        """The common name of the certificate that this client shows, "" without one."""
        # `like` makes another sender of commands on this connection, but not another caller.
        self._secret = new_secret()
        self._sign_as(f"{platform.node()[:32]}/{os.getpid()}")
        self._sequence = 0
        # The wall clock may be set while we drive, and the daemon would take that for a delay.
        self._wall_offset_ns = clock.now().wall_ns - clock.steady_ns()

    def _sign_as(self, name: str) -> None:
        self._sender_id = sender_id(name)
        self.sender = public_name(self._sender_id, self.certificate)
        """The name that `state.sender` has while the robot follows this client."""

    @property
    def caller(self) -> str:
        """The sender id on each call: `name` with a secret. The daemon's log shows its public
        name."""
        return sender_id(self.name, self._secret)

    def like(self, robot_id: str, name: str = "") -> Client:
        """Return a client of another robot on the same connection, or another sender to this one.

        `name` is the sender's name; by default it is that of this process.
        """
        other = Client(self.session, robot_id, self.source, self._tls, self._endpoint)
        other.name, other._secret, other._puts = self.name, self._secret, self._puts
        if name:
            other._sign_as(name)
        return other

    def key(self, name: str) -> str:
        """The full key of a name of the topic table, for example "odom"."""
        return full_key(self._id, name)

    def command_key(self, source: str) -> str:
        """The key below the robot's id that this client commands on as `source`.

        Over TLS that is a key of its certificate.
        """
        return command_key("cmd", source, self.certificate)

    def send(self, linear: float, angular: float = 0.0, *, stamp_ns: int | None = None) -> None:
        """Send one command: `linear` m/s, `angular` rad/s (left is +). Repeat it to keep moving.

        The first call sends a zero in its place, since the daemon wants one before it drives.
        `stamp_ns` is when it was meant, by the clock of whoever meant it, where we only pass it on.
        """
        if self._opened:
            self._put(linear, angular, stamp_ns)
        else:
            self._opened = True
            self._put(0.0, 0.0, stamp_ns)

    def drive(self, linear: float, angular: float = 0.0, *, seconds: float) -> None:
        """Drive for so long (above 0 s), then to a stand; returns when the robot stands.

        Above its `[limits]` the robot drives at them, and that is no error: `get("config")` has
        them, `get("cmd_vel_out")` what is applied. Raises `NotDrivenError` with the daemon's reason
        as soon as it does not follow us.
        """
        try:
            with closing(drive(self, linear, angular, seconds)) as steps:
                for pause in steps:
                    time.sleep(pause)
        except (UnheardError, NoAnswerError) as error:
            raise self.unheard(error) from None

    def call(self, service: str, **fields: float) -> schema.ServiceReply:
        """Call `stop`, `clear`, `activate`, `deactivate`, `reset_odometry` or `set_pose`.

        `clear` releases the stop or fault that `state` shows now, and `activate` switches on a
        robot that `state` shows as switched off now. Pass `latch=state.latch` of the state that a
        person has looked at, and the daemon refuses if a stop or a `deactivate` came since.
        """
        if service in ("clear", "activate") and "latch" not in fields:
            fields["latch"] = self.get("state").latch
        return self.request(service, fields)

    def set(self, settings: Mapping[str, Plain]) -> schema.ServiceReply:
        """Change settings until the next start: `{"rates.state": 5.0}`; all or none.

        A lowered speed, acceleration or jerk of `limits` survives the next start.
        """
        return self.request("set", {"settings": settings})

    def request(self, service: str, fields: Mapping[str, object]) -> schema.ServiceReply:
        """The same for any service, with its payload as it is."""
        payload = msgspec.json.encode(fields) if fields else None
        return Decoder(schema.ServiceReply).decode(*self._ask(service_key(service), payload))

    def get(self, name: str) -> Any:
        """The last value of a published key as its typed message, or of `info`, `config`, …"""
        return decoder(name).decode(*self.reply(name))

    def reply(self, name: str) -> tuple[str, bytes]:
        """The same as it came: encoding and payload."""
        return self._ask(name)

    def whoami(self) -> Identity:
        """Who we are to the daemon; the role is "" when it answers none of them."""
        return identity(self.ask, self._tls, self.sender, self._id, self._endpoint)

    def pose(self) -> Pose:
        """Where base_link is in odom now."""
        state = self.get("state")
        return Pose(state.x, state.y, state.yaw)

    def messages(self, name: str, timeout: float | None = None) -> Iterator[Any]:
        """The typed messages of a published key as they come.

        Ends after `timeout` s of silence, and when the connection is closed.
        """
        reader = decoder(name)
        for sample in self.subscribe(name).until_silence(timeout):
            yield reader.decode(*encoded(sample))

    def samples(self, name: str, timeout: float | None = None) -> Iterator[zenoh.Sample]:
        """The raw samples of any key below the robot's id, whatever key they were put on."""
        yield from Subscription(self._queue(name)).until_silence(timeout)

    def listen(self, name: str, callback: Callable[[zenoh.Sample], None]) -> Any:
        """Call back for each sample of a key, on a thread of Zenoh's; `undeclare` it to end."""
        try:
            return self.session.declare_subscriber(self.key(name), callback)
        except zenoh.ZError:
            raise _no_key(name) from None

    def subscribe(self, name: str) -> Subscription:
        """The raw samples of a key, for a loop of your own, which must not wait here."""
        return Subscription(self._queue(name), self.key(name))

    def ask(self, name: str, take: Callable[[zenoh.Sample], object]) -> None:
        """Call back with the last value of a key, if it comes, on a thread of Zenoh's."""
        self.session.get(
            self.key(name),
            lambda reply: take(reply.ok) if reply.ok is not None else None,
            timeout=REPLY_TIMEOUT_S,
        )

    def _queue(self, name: str) -> Any:
        topic = by_key(name)
        try:
            return queue_on(
                self.session, self.key(name), latched=topic is not None and topic.latched
            )
        except zenoh.ZError:
            raise _no_key(name) from None

    def _put(self, linear: float, angular: float, stamp_ns: int | None) -> None:
        self._puts.wait()
        steady = stamp_ns is None
        if stamp_ns is None:
            stamp_ns = clock.steady_ns() + self._wall_offset_ns
        message = schema.TwistStamped(
            schema.Header(schema.Time.from_ns(stamp_ns)),
            schema.Twist(schema.Vector3(x=linear), schema.Vector3(z=angular)),
        )
        self._sequence += 1
        self.session.put(
            self.key(self.command_key(self.source)),
            encode(message, "msgpack"),
            encoding=encoding_name("msgpack", "TwistStamped"),
            express=True,
            attachment=Signature(self._sender_id, stamp_ns, self._sequence, steady).pack(),
            timestamp=self.session.new_timestamp(),
        )

    def _ask(self, name: str, payload: bytes | None = None) -> tuple[str, bytes]:
        """The first answer: a stranger may give any number of others."""
        end_s = time.monotonic() + REPLY_TIMEOUT_S
        while True:
            reply = self._first(name, payload)
            if reply is None:
                raise self._unanswered(name)
            if reply.ok is not None:
                return encoded(reply.ok)
            said = reply.err.payload.to_string() if reply.err is not None else ""
            if said == TIMED_OUT:
                raise NoAnswerError(
                    f"no answer on {self.key(name)} within {REPLY_TIMEOUT_S:g} s: the daemon or "
                    "the way to it is stuck; `acsard doctor` on the robot looks at it, or try again"
                )
            # A question is asked again; not what somebody else may have decided otherwise since.
            if said != BUSY or name in VERBS or time.monotonic() > end_s:
                raise ReplyError(f"{name}: {said}")
            time.sleep(AGAIN_S)

    def _first(self, name: str, payload: bytes | None) -> zenoh.Reply | None:
        try:
            replies = self.session.get(
                self.key(name),
                payload=payload,
                attachment=Signature(self.caller).pack(),
                timeout=REPLY_TIMEOUT_S,
            )
        except zenoh.ZError:
            raise _no_key(name) from None
        return next(iter(replies), None)

    def _unanswered(self, name: str) -> MendableError:
        """Why nobody answers: one reason where one can be seen."""
        key, no_answer = name.partition("?")[0], f"no answer on {self.key(name)}"
        if unknown(key):
            return NoAnswerError(f"{no_answer}: {key} is not in the topic table ({key_hint(key)})")
        if self._tls:
            us = self.whoami()
            if us.silence:
                return NoAnswerError(f"{no_answer}: {us.silence}")
            if why := us.lacks(key):
                return NotPermittedError(why)
        seen = around(self.session, self._id, self._endpoint)
        if seen is None or seen.here or not self._endpoint:
            return NoAnswerError(
                f"{no_answer}; is the daemon of robot.id {self._id!r} stuck, or has it no such key "
                "(`acsard topics`), and may you ask it?"
            )
        return NoAnswerError(f"{no_answer}: {why_quiet(key, self._id, self._endpoint, seen)}")

    def unheard(self, error: UnheardError | NoAnswerError) -> MendableError:
        """The same by its documented name, with what our certificate has to do with it."""
        if isinstance(error, UnheardError) and not self._tls:
            return NotDrivenError(str(error))
        if not self._tls:
            return error
        us = self.whoami()
        if us.silence:
            return NoAnswerError(f"{error}; {us.silence}")
        if isinstance(error, NoAnswerError):
            return error
        if us.role == "viewer":
            return NotPermittedError(us.words())
        return NotDrivenError(f"{error}; {us.words()}")


def _no_key(name: str) -> UsageError:
    return UsageError(f"{name!r} is not a key; `acsard topics` lists them")


def decoder(name: str) -> Decoder[Any]:
    """The decoder of a key's type; plain dictionaries where it has none (config, schema/…)."""
    topic = by_key(name)
    cls = None if topic is None else schema.MESSAGES.get(topic.type)
    return Decoder(cls or dict)
