"""Handles connections whose client sends no request, so that `admission.py` has none to refuse.

It limits the number of TCP connections and the time until the first request. It also answers bytes
that are not an HTTP request with words, and counts them. aiohttp alone would answer with a bare
line, and log a traceback for each.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from aiohttp import web
from aiohttp.web_protocol import RequestHandler

from acsard.host.rate_limits import Places
from acsard.web.answers import HEADERS, problem
from acsard.web.callers import unmapped
from acsard.web.counts import Counts

SOCKETS, SOCKETS_OF_ONE = 256, 64
"""Maximum number of TCP connections per listening address, in all and from one client address. A
browser opens six in addition to its WebSocket."""

REQUEST_S = 10.0
"""Time limit for the head of the first request; the connection is cut after that."""

NO_HOST = "the request has no `Host`, the name of the robot"

NO_REQUEST = "that is not an HTTP request"

MISSING = "Missing 'Host'"
"""Start of aiohttp's message for a missing `Host` header."""

Factory = Callable[[], asyncio.Protocol]


class Gate:
    """The open connections."""

    def __init__(self, counts: Counts) -> None:
        self.counts = counts
        self._connections: dict[asyncio.BaseTransport, _Connection] = {}

    def guarded(self, inner: Factory) -> Factory:
        """Wrap a protocol factory so that each connection passes this gate first.

        Each call has limits of its own. The server calls it once per listening address, so clients
        from the network can never lock out a browser on the robot itself.
        """
        places = Places(SOCKETS, SOCKETS_OF_ONE)
        return lambda: _Connection(self, places, inner)

    def spoke(self, transport: asyncio.BaseTransport | None) -> None:
        """Cancel the time limit of this connection, because a request has arrived."""
        if transport is not None and (connection := self._connections.get(transport)) is not None:
            connection.hurry(False)

    def opened(self, transport: asyncio.BaseTransport, connection: _Connection) -> None:
        self._connections[transport] = connection

    def closed(self, transport: asyncio.BaseTransport) -> None:
        self._connections.pop(transport, None)


class _Connection(asyncio.Protocol):
    """One connection. The inner protocol is created only if the limits allow it."""

    def __init__(self, gate: Gate, places: Places, inner: Factory) -> None:
        self._gate, self._places, self._make = gate, places, inner
        self._inner: asyncio.Protocol | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._peer = ""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        peer = transport.get_extra_info("peername")
        self._peer = unmapped(str(peer[0])) if peer else ""
        self._transport = transport
        if not self._places.enter(self._peer):
            self._gate.counts.refuse("crowded", self._peer)
            transport.abort()  # type: ignore[attr-defined]
            return
        self._inner = self._make()
        self._gate.opened(transport, self)
        self.hurry(True)
        self._inner.connection_made(transport)

    def hurry(self, on: bool) -> None:
        """Start the time limit for the first request, or cancel it."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None
        if on:
            self._timer = asyncio.get_running_loop().call_later(REQUEST_S, self._give_up)

    def _give_up(self) -> None:
        self._gate.counts.refuse("slow", self._peer)
        self._transport.abort()  # type: ignore[attr-defined]

    def data_received(self, data: bytes) -> None:
        if self._inner is not None:
            self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        return None if self._inner is None else self._inner.eof_received()

    def pause_writing(self) -> None:
        if self._inner is not None:
            self._inner.pause_writing()

    def resume_writing(self) -> None:
        if self._inner is not None:
            self._inner.resume_writing()

    def connection_lost(self, error: Exception | None) -> None:
        self.hurry(False)
        if self._inner is None:
            return
        self._places.leave(self._peer)
        self._gate.closed(self._transport)
        self._inner.connection_lost(error)


class Reader(RequestHandler):
    """Protocol handler of one connection."""

    def __init__(self, counts: Counts, server: Any) -> None:
        """Create a handler for `server`, which is the server of the application's runner."""
        super().__init__(server, loop=server._loop, **server._kwargs)
        self._counted = counts

    def handle_error(
        self,
        request: web.BaseRequest,
        status: int = 500,
        exc: BaseException | None = None,
        message: str | None = None,
    ) -> web.StreamResponse:
        """Answer unreadable bytes.

        Errors of the application (status 500 and above) stay with aiohttp.
        """
        if status >= 500:
            return super().handle_error(request, status, exc, message)
        nameless = (message or "").startswith(MISSING)
        peer = unmapped(request.remote or "")
        self._counted.refuse("host" if nameless else "malformed", peer)
        response = problem(status, NO_HOST if nameless else NO_REQUEST)
        response.headers.update(HEADERS)
        response.force_close()
        return response
