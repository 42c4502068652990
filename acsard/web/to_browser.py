"""What goes out on one WebSocket: the newest of each key when it is due, and answers at once.

While the client has not read what went before, the newest is left out; it never waits in a queue.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from contextlib import suppress

import aiohttp
import msgspec
from aiohttp import web

from acsard.host import clock
from acsard.values import NS_PER_S
from acsard.web.counts import Counts
from acsard.web.streams import Stream
from acsard.web.told import Refused
from acsard.web.who import Reason

UNREAD_BYTES = 32768
"""More than this not yet read by the client: it gets nothing new until it has."""

UNREAD_FRAMES = 200
"""Answers that wait to go out; the oldest are dropped beyond."""

CLOSES_S = 1.0
"""For the client's answer to a close; then the connection is cut."""

TELL_NS = NS_PER_S
"""A refusal of one reason is told so often at most; all are counted."""


class Following:
    """A key that is sent, and when it is due."""

    def __init__(self, robot: str, name: str, own: str, period: float) -> None:
        """`own` is the id of the robot whose page it is: of that one the id goes without saying."""
        self.robot, self.name, self.period = robot, name, period
        told = {"key": name} if robot == own else {"key": name, "robot": robot}
        self.head = msgspec.json.encode(told)[:-1] + b',"value":'
        self.stream: Stream | None = None
        self.sent = 0
        self.due = 0.0


class Outgoing:
    """To one client."""

    def __init__(
        self, socket: web.WebSocketResponse, request: web.Request, counts: Counts, origin: str
    ) -> None:
        """`origin` is who it is, for the log."""
        self._socket, self._transport, self._counts = socket, request.transport, counts
        self._origin = origin
        self.following: dict[tuple[str, str], Following] = {}
        """By robot and key."""
        self._out: deque[bytes] = deque(maxlen=UNREAD_FRAMES)
        self._news = asyncio.Event()
        self._told: dict[str, int] = {}
        self._closing = False

    def say(self, message: object) -> None:
        """As soon as the client reads."""
        self._out.append(msgspec.json.encode(message))
        self._news.set()

    def wake(self) -> None:
        """There is something new to send, or to follow."""
        self._news.set()

    def refuse(self, what: str, reason: Reason, text: str) -> None:
        """Counted, and told once a second for each reason."""
        self._counts.refuse(reason, self._origin)
        now_ns = clock.mono_ns()
        if now_ns - self._told.get(reason, -TELL_NS) >= TELL_NS:
            self._told[reason] = now_ns
            self.say(Refused(what, text))

    async def pump(self, look_around: Callable[[float], float]) -> None:
        """Until cancelled, or the connection closes; `look_around` says when it is due again."""
        loop = asyncio.get_running_loop()
        try:
            while True:
                self._news.clear()
                await self._send_what_waits()
                now = loop.time()
                due = [await self._send_due(one, now) for one in list(self.following.values())]
                due.append(look_around(now))
                timer = loop.call_at(min(due), self._news.set)
                try:
                    await self._news.wait()
                finally:
                    timer.cancel()
        except ConnectionError:
            pass  # it is closing, which `run` sees

    async def close(self, why: str) -> None:
        """Tell the client to end the connection; `why` is at most 120 characters.

        Cut at once, it could not answer, and many programs would take that for a network that is
        gone, whatever was said before.
        """
        if self._closing:
            return
        self._closing = True
        if self._transport is not None:
            asyncio.get_running_loop().call_later(CLOSES_S, self._transport.abort)
        said = aiohttp.WSCloseCode.POLICY_VIOLATION.to_bytes(2, "big") + why.encode()
        with suppress(ConnectionError):
            await self._socket.send_frame(said, aiohttp.WSMsgType.CLOSE)

    async def _send(self, text: bytes) -> None:
        if not self._closing:  # nothing comes after a close
            await self._socket.send_frame(text, aiohttp.WSMsgType.TEXT)

    async def _send_what_waits(self) -> None:
        while self._out:
            await self._send(self._out.popleft())

    async def _send_due(self, one: Following, now: float) -> float:
        """Send it if it is time and there is news; when it is due next, by the loop's clock."""
        stream = one.stream
        if stream is None:
            return now + one.period  # `_join` says when it is there
        if one.due > now:
            return one.due
        # On a grid that all share: they wake up together.
        one.due = (now // one.period + 1) * one.period
        if stream.number != one.sent:
            if self._unread() > UNREAD_BYTES:
                self._counts.add("frames_left_out")
            else:
                one.sent, value, age = stream.value()
                frame = b'%b%b,"age":%.1f}' % (one.head, value, age)
                await self._send(frame)
        return one.due

    def _unread(self) -> int:
        return 0 if self._transport is None else self._transport.get_write_buffer_size()
