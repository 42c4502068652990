"""Sends messages and the values of subscribed keys to the client of one WebSocket.

While the client does not read, the server skips new values of the keys instead of queueing them. A
beat is sent as soon as it arrives, ahead of everything else: its delay adds to the age of the
client's commands.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from contextlib import suppress

import aiohttp
import msgspec
from aiohttp import web

from acsard.core.messages.keys_and_roles import BEAT
from acsard.core.throttle import Rate, Throttle
from acsard.host import clock
from acsard.web.answers import cut, unsent_bytes
from acsard.web.callers import Reason
from acsard.web.metrics import Counts
from acsard.web.socket_messages import Refused
from acsard.web.streams import VIEWER_KEYS, Stream, Streams

# Above this, the client gets no new values. It is less than `connections.WRITE_BYTES`, so that a
# client that does not read delays no task.
MAX_UNREAD_BYTES = 32768

# Sum of all keys of a WebSocket. More would take processor time from the commands.
MAX_FRAMES_HZ = 300.0


# Of reports about refused messages, for each kind of message and each reason: a client that sends
# many and reads none would not read why its connection ends.
REPORT_RATE = Rate(1.0)


class Following:
    """A key to which the client is subscribed, and the time at which to send its next value."""

    def __init__(self, name: str, period: float, stream: Stream) -> None:
        self.name, self.period, self.stream = name, period, stream
        self.head = msgspec.json.encode({"key": name})[:-1] + b',"value":'
        self.sent = 0
        self.due = 0.0

    def next(self) -> bytes:
        """Return the message with the newest value."""
        self.sent, value, age = self.stream.value()
        return b'%b%b,"age":%.1f}' % (self.head, value, age)


class Outgoing:
    """Sends the messages and the values of subscribed keys to the client of one WebSocket."""

    def __init__(
        self,
        socket: web.WebSocketResponse,
        request: web.Request,
        streams: Streams,
        counts: Counts,
        origin: str,
    ) -> None:
        self._socket, self._transport, self._counts = socket, request.transport, counts
        self._streams, self._origin = streams, origin
        self.following: dict[str, Following] = {}  # by key
        # The queue is limited, because the client may have stopped reading.
        self._out: deque[tuple[bytes, aiohttp.WSMsgType]] = deque(maxlen=200)
        self._news, self._loop = asyncio.Event(), asyncio.get_running_loop()
        self._reports = Throttle()
        self._closing = False

    def enqueue(self, message: object) -> None:
        """Queue a message. If more than 200 wait, the oldest one is dropped."""
        self._queue(msgspec.json.encode(message), aiohttp.WSMsgType.TEXT)

    def pong(self, data: bytes) -> None:
        """Queue the answer to a ping, like a message."""
        self._queue(data, aiohttp.WSMsgType.PONG)

    def _queue(self, data: bytes, kind: aiohttp.WSMsgType) -> None:
        self._out.append((data, kind))
        self._news.set()

    def _wake_from_thread(self) -> None:
        with suppress(RuntimeError):  # the event loop may have ended
            self._loop.call_soon_threadsafe(self._news.set)

    def refuse(self, what: str, reason: Reason, text: str) -> None:
        """Count a refused message, and report it to the client within `REPORT_RATE`."""
        self._counts.refuse(reason, self._origin)
        if self._reports.take(clock.mono_ns(), REPORT_RATE, f"{what} {reason}"):
            self.enqueue(Refused(what, text))

    def subscribe(self, key: str, rate: float) -> None:
        """Subscribe to a key or change its rate, or report to the client why not."""
        known = self.following.get(key)
        others = sum(1.0 / other.period for other in self.following.values() if other is not known)
        if key not in VIEWER_KEYS:
            keys = ", ".join(sorted(VIEWER_KEYS))
            text = f"{key!r} is not a key to follow; choose one of {keys}"
            self.refuse("subscribe", "malformed", text)
        elif others + rate > MAX_FRAMES_HZ:
            text = (
                f"the rates of your keys add up to more than {MAX_FRAMES_HZ:g} messages a second: "
                "lower some of them"
            )
            self.refuse("subscribe", "too_many", text)
        elif known is not None:
            known.period, known.due = 1.0 / rate, 0.0
        else:
            stream = self._streams.follow(key)
            self.following[key] = Following(key, 1.0 / rate, stream)
            if key == BEAT:
                stream.wakes.add(self._wake_from_thread)
        self._news.set()

    def unsubscribe(self, key: str) -> None:
        subscription = self.following.pop(key, None)
        if subscription is not None:
            subscription.stream.wakes.discard(self._wake_from_thread)
            self._streams.leave(key)

    def unsubscribe_all(self) -> None:
        for key in list(self.following):
            self.unsubscribe(key)

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
        self._closing = True
        # Cut off a client that does not answer the close frame in time.
        asyncio.get_running_loop().call_later(1.0, cut, self._transport)
        payload = aiohttp.WSCloseCode.POLICY_VIOLATION.to_bytes(2, "big") + why.encode()
        with suppress(ConnectionError):
            await self._socket.send_frame(payload, aiohttp.WSMsgType.CLOSE)

    async def _send(self, data: bytes, kind: aiohttp.WSMsgType = aiohttp.WSMsgType.TEXT) -> None:
        if not self._closing:  # no data may follow a close frame
            await self._socket.send_frame(data, kind)

    async def _send_beat(self) -> None:
        beats = self.following.get(BEAT)
        if beats is not None and beats.stream.number != beats.sent:
            await self._send(beats.next())

    async def _send_what_waits(self) -> None:
        while self._out:
            await self._send_beat()
            await self._send(*self._out.popleft())

    async def _send_due(self, subscription: Following, now: float) -> float:
        if subscription.name == BEAT:
            return now + subscription.period  # each beat wakes the task
        if subscription.due > now:
            return subscription.due
        # All keys share one time grid, so they wake the task together.
        subscription.due = (now // subscription.period + 1) * subscription.period
        if subscription.stream.number != subscription.sent:
            if unsent_bytes(self._transport) > MAX_UNREAD_BYTES:
                self._counts.add("frames_left_out")
            else:
                await self._send_beat()
                await self._send(subscription.next())
        return subscription.due
