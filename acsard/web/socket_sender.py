"""Sends messages and the values of subscribed keys to the client of one WebSocket.

While the client does not read, the server skips new values of the keys instead of queueing them. A
beat is sent as soon as it arrives, ahead of everything else: its delay adds to the age of the
client's commands.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any

import aiohttp
import msgspec
from aiohttp import web

from acsard.core.messages.keys_and_roles import BEAT
from acsard.host import clock
from acsard.host.rate_limits import Buckets, Rate
from acsard.web.answers import cut
from acsard.web.callers import Reason
from acsard.web.followed_robot import RETRY_DELAY_S, FollowedRobot
from acsard.web.metrics import Counts
from acsard.web.socket_messages import Refused, Subscribe, Unsubscribe
from acsard.web.streams import NOT_READY_ERRORS, VIEWER_KEYS, Stream

# Above this, the client gets no new values. It is less than `connections.WRITE_BYTES`, so that a
# client that does not read delays no task.
MAX_UNREAD_BYTES = 32768

# Of reports about refused messages, for each kind of message and each reason.
REPORT_RATE = Rate(1.0)


class Following:
    """A key to which the client is subscribed, and the time at which to send its next value."""

    def __init__(self, name: str, period: float) -> None:
        self.name, self.period = name, period
        self.head = msgspec.json.encode({"key": name})[:-1] + b',"value":'
        self.stream: Stream | None = None
        self.sent = 0
        self.due = 0.0

    def next(self, stream: Stream) -> bytes:
        """Return the message with the newest value."""
        self.sent, value, age = stream.value()
        return b'%b%b,"age":%.1f}' % (self.head, value, age)


class Outgoing:
    """Sends the messages and the values of subscribed keys to the client of one WebSocket."""

    def __init__(
        self, socket: web.WebSocketResponse, request: web.Request, counts: Counts, origin: str
    ) -> None:
        self._socket, self._transport, self._counts = socket, request.transport, counts
        self._origin = origin
        self.following: dict[str, Following] = {}  # by key
        # The queue is limited, because the client may have stopped reading.
        self._out: deque[bytes] = deque(maxlen=200)
        self._pong: bytes | None = None  # payload of the newest unanswered ping
        self._news, self._loop = asyncio.Event(), asyncio.get_running_loop()
        self._reports = Buckets(REPORT_RATE)
        self._closing = False

    def enqueue(self, message: object) -> None:
        """Queue a message. If more than 200 wait, the oldest one is dropped."""
        self._out.append(msgspec.json.encode(message))
        self._news.set()

    def wake(self) -> None:
        self._news.set()

    def wake_from_thread(self) -> None:
        with suppress(RuntimeError):  # the event loop may have ended
            self._loop.call_soon_threadsafe(self._news.set)

    def refuse(self, what: str, reason: Reason, text: str) -> None:
        """Count a refused message, and report it to the client within `REPORT_RATE`."""
        self._counts.refuse(reason, self._origin)
        if self._reports.take(f"{what} {reason}", clock.mono_ns()):
            self.enqueue(Refused(what, text))

    async def pump(self, look_around: Callable[[float], float]) -> None:
        """Send messages until the task is cancelled or the connection closes.

        After each round, `look_around` gets the time of the event loop's clock and returns its next
        one.
        """
        loop = self._loop
        try:
            while True:
                self._news.clear()
                await self._send_beat()
                await self._send_what_waits()
                now = loop.time()
                due = [
                    await self._send_due(subscription, now)
                    for subscription in list(self.following.values())
                ]
                due.append(look_around(now))
                timer = loop.call_at(min(due), self._news.set)
                try:
                    await self._news.wait()
                finally:
                    timer.cancel()
        except ConnectionError:
            pass  # closing; `Viewer.run` notices

    async def close(self, why: str) -> None:
        """Send a close frame with a reason (120 characters), and cut the connection 1 s later.

        If it were cut at once, many clients would report a network failure instead of the reason.
        """
        if self._closing:
            return
        self._closing = True
        # Cut off a client that does not answer the close frame in time.
        asyncio.get_running_loop().call_later(1.0, cut, self._transport)
        payload = aiohttp.WSCloseCode.POLICY_VIOLATION.to_bytes(2, "big") + why.encode()
        with suppress(ConnectionError):
            await self._socket.send_frame(payload, aiohttp.WSMsgType.CLOSE)

    def cut(self) -> None:
        """End the connection without a reason."""
        self._closing = True
        cut(self._transport)

    def pong(self, data: bytes) -> None:
        """Queue the answer to a ping.

        It replaces an unsent one, so a client that reads nothing cannot fill the memory.
        """
        self._pong = data
        self._news.set()

    async def _send(self, data: bytes, kind: aiohttp.WSMsgType = aiohttp.WSMsgType.TEXT) -> None:
        await self._send_beat()
        await self._send_frame(data, kind)

    async def _send_frame(self, data: bytes, kind: aiohttp.WSMsgType) -> None:
        if not self._closing:  # no data may follow a close frame
            await self._socket.send_frame(data, kind)

    async def _send_beat(self) -> None:
        beats = self.following.get(BEAT)
        if beats is not None and beats.stream is not None and beats.stream.number != beats.sent:
            await self._send_frame(beats.next(beats.stream), aiohttp.WSMsgType.TEXT)

    async def _send_what_waits(self) -> None:
        if self._pong is not None:
            data, self._pong = self._pong, None
            await self._send(data, aiohttp.WSMsgType.PONG)
        while self._out:
            await self._send(self._out.popleft())

    async def _send_due(self, subscription: Following, now: float) -> float:
        stream = subscription.stream
        if stream is None or subscription.name == BEAT:
            return now + subscription.period  # `Keys._join` wakes the task when the stream exists
        if subscription.due > now:
            return subscription.due
        # All keys share one time grid, so they wake the task together.
        subscription.due = (now // subscription.period + 1) * subscription.period
        if stream.number != subscription.sent:
            if self._unread() > MAX_UNREAD_BYTES:
                self._counts.add("frames_left_out")
            else:
                await self._send(subscription.next(stream))
        return subscription.due

    def _unread(self) -> int:
        return 0 if self._transport is None else self._transport.get_write_buffer_size()


# Sum of all keys of a WebSocket. More would take processor time from the commands.
MAX_FRAMES_HZ = 300.0


class Keys:
    """The subscriptions of one WebSocket. `start` starts a task that ends with it."""

    def __init__(
        self,
        out: Outgoing,
        robot: FollowedRobot,
        start: Callable[[Coroutine[Any, Any, None]], None],
    ) -> None:
        self._out, self._robot, self._start = out, robot, start

    def subscribe(self, frame: Subscribe) -> None:
        """Subscribe to a key or change its rate, or report to the client why not."""
        key = frame.subscribe
        known = self._out.following.get(key)
        if (refusal := self._refusal(key, frame.rate, known)) is not None:
            self._out.refuse("subscribe", *refusal)
        elif known is not None:
            known.period, known.due = 1.0 / frame.rate, 0.0
            self._out.wake()
        else:
            subscription = Following(key, 1.0 / frame.rate)
            self._out.following[key] = subscription
            self._start(self._join(subscription))

    def _refusal(self, key: str, rate: float, known: Following | None) -> tuple[Reason, str] | None:
        if key not in VIEWER_KEYS:
            keys = ", ".join(sorted(VIEWER_KEYS))
            return "malformed", f"{key!r} is not a key to follow; choose one of {keys}"
        following = self._out.following
        others = sum(1.0 / other.period for other in following.values() if other is not known)
        if others + rate > MAX_FRAMES_HZ:
            return "too_many", (
                f"the rates of your keys add up to more than {MAX_FRAMES_HZ:g} messages a second: "
                "lower some of them"
            )
        return None

    def unsubscribe(self, frame: Unsubscribe) -> None:
        # Remove the key immediately, because the client's next message may subscribe to it again.
        subscription = self._out.following.pop(frame.unsubscribe, None)
        if subscription is not None:
            self._leave(subscription)

    def leave_all(self) -> None:
        followed, self._out.following = self._out.following, {}
        for subscription in followed.values():
            self._leave(subscription)

    def _leave(self, subscription: Following) -> None:
        if subscription.stream is not None:
            subscription.stream.wakes.discard(self._out.wake_from_thread)
            self._robot.streams.leave(subscription.name)

    async def _join(self, subscription: Following) -> None:
        stream = None
        while stream is None and self._is_followed(subscription):
            stream = await self._follow(subscription)
        if stream is None:
            return
        if not self._is_followed(subscription):  # the viewer unsubscribed during the wait
            self._robot.streams.leave(subscription.name)
            return
        subscription.stream = stream
        if subscription.name == BEAT:
            stream.wakes.add(self._out.wake_from_thread)
        self._out.wake()

    async def _follow(self, subscription: Following) -> Stream | None:
        client = self._robot.client
        if client is None:
            await asyncio.sleep(0.2)
            return None
        try:
            return await self._robot.streams.follow(client, subscription.name)
        except NOT_READY_ERRORS:
            self._out.refuse(
                "subscribe", "stuck", "the Zenoh bus is stuck; the page tries again by itself"
            )
            await asyncio.sleep(RETRY_DELAY_S)
            return None

    def _is_followed(self, subscription: Following) -> bool:
        return self._out.following.get(subscription.name) is subscription
