"""Accepts TCP connections, up to a maximum in total, from each address, and with each token.

A stranger may make the page slow or unreachable, and can do nothing else. So the server closes a
connection beyond a maximum at once, and never displaces an older one: the memory and the open files
of this process are bounded, and a page that is open stays open. The robot itself has places of its
own.
"""

from __future__ import annotations

import asyncio
import socket
import ssl
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Never, Protocol

from aiohttp import StreamReader, web

from acsard.web.answers import HEADERS, cut, problem, unsent_bytes
from acsard.web.callers import is_loopback, network_of, unmapped
from acsard.web.metrics import Counts

# From other machines, in total and from each network (`network_of`), and from the robot itself.
# asyncio gives each TLS connection buffers of about 0.3 MB. A browser opens seven connections.
MAX_CONNECTIONS, MAX_OF_NETWORK, MAX_LOCAL = 128, 64, 64

MAX_OF_TOKEN = 8

# Time limit of a TLS handshake; for the first request, and for each further one; and for a client
# to acknowledge what was sent to it.
HANDSHAKE_S, IDLE_S, UNREAD_S = 3.0, 8.0, 5.0

# Read buffer of a connection, and the answers that may wait for a client that reads slowly.
READ_BYTES, WRITE_BYTES = 16384, 65536

# Requests behind the present one: more than any client sends that waits for its answers. aiohttp
# would keep 32 requests, whose heads take 0.5 MB each.
MAX_WAITING_BYTES = 131072

# Of a request. A browser sends the cookies for all ports of a host in one header, so less could
# lock it out.
FIELD_BYTES, FIELDS = 8190, 32


class HasContext(Protocol):
    """The certificate of a listening socket, which may be replaced."""

    context: ssl.SSLContext


class Places:
    """Limits the number of simultaneous uses, such as connections, in total and for each name."""

    def __init__(self, most: int, per_name: int) -> None:
        self._most, self._per_name = most, per_name
        self._counts: Counter[str] = Counter()

    @property
    def taken(self) -> int:
        return self._counts.total()

    def room(self, name: str) -> bool:
        return self._counts[name] < self._per_name and self.taken < self._most

    def enter(self, name: str) -> bool:
        """Take a place; return False if none is free."""
        if not self.room(name):
            return False
        self._counts[name] += 1
        return True

    def leave(self, name: str) -> None:
        self._counts[name] -= 1
        if not self._counts[name]:
            del self._counts[name]


class Connections:
    """The open connections of all clients."""

    def __init__(self, counts: Counts) -> None:
        self.counts = counts
        self._away = Places(MAX_CONNECTIONS, MAX_OF_NETWORK)
        self._here = Places(MAX_LOCAL, MAX_LOCAL)
        self._all = set[HttpConnection]()
        self._of_token: dict[str, list[HttpConnection]] = {}

    async def accept(
        self,
        server: web.Server,
        listening: socket.socket,
        certificate: HasContext | None,
    ) -> Never:
        """Serve the connections to a listening socket until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            # One connection in each turn of the event loop, so that a crowd delays no other work.
            await asyncio.sleep(0)
            try:
                accepted, place = await loop.sock_accept(listening)
            except OSError:  # the client has gone, or this process may open no more files
                await asyncio.sleep(0.05)
                continue
            peer = unmapped(str(place[0]))
            places = self._here if is_loopback(peer) else self._away
            if places.enter(network_of(peer)):
                connection = HttpConnection(self, server, peer, places)
                self._all.add(connection)
                opening = self._open(connection, accepted, certificate)
                connection.opening = asyncio.create_task(opening)
            else:
                self.counts.refuse("crowded", peer)
                accepted.close()

    def claim(self, connection: HttpConnection, token: str) -> bool:
        """Count a connection for the token of its request.

        If the token has `MAX_OF_TOKEN` other connections, an idle one of them is closed. Returns
        False if none is idle.
        """
        if connection.token == token:
            return True
        its = self._of_token.get(token, [])
        if len(its) >= MAX_OF_TOKEN:
            idle = next((other for other in its if not other.is_busy), None)
            if idle is None:
                return False
            self._disown(idle)
            idle.cut()
        self._disown(connection)
        connection.token = token
        self._of_token.setdefault(token, []).append(connection)
        return True

    def tokens(self) -> list[str]:
        """Return the digests of the tokens of all connections."""
        return list(self._of_token)

    def end(self, token: str, why: str, but: HttpConnection | None = None) -> None:
        """End the connections of a token; WebSockets get the reason (120 characters at most)."""
        for connection in list(self._of_token.get(token, ())):
            if connection is not but:
                connection.end(why)

    def left(self, connection: HttpConnection) -> None:
        """Note that a connection has ended, or could not be opened."""
        if connection in self._all:
            self._all.remove(connection)
            connection.places.leave(network_of(connection.peer))
            self._disown(connection)

    def _disown(self, connection: HttpConnection) -> None:
        its = self._of_token.get(connection.token, [])
        if connection in its:
            its.remove(connection)
        if not its:
            self._of_token.pop(connection.token, None)
        connection.token = ""

    async def _open(
        self,
        connection: HttpConnection,
        accepted: socket.socket,
        certificate: HasContext | None,
    ) -> None:
        tls = None if certificate is None else certificate.context
        accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * UNREAD_S))
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: connection,
                accepted,
                ssl=tls,
                ssl_handshake_timeout=HANDSHAKE_S if tls else None,
                ssl_shutdown_timeout=1.0 if tls else None,
            )
        except OSError as error:
            if isinstance(error, ConnectionAbortedError):
                self.counts.refuse("slow", connection.peer)
            # The frames of the traceback would keep the TLS buffers until the next garbage
            # collection.
            traceback.clear_frames(error.__traceback__)
        finally:
            if connection.transport is None:
                self.left(connection)


class HttpConnection(web.RequestHandler):
    """aiohttp's handler of one connection, which serves one request at a time."""

    def __init__(
        self,
        connections: Connections,
        server: web.Server,
        peer: str,
        places: Places,
    ) -> None:
        super().__init__(
            server,
            loop=asyncio.get_running_loop(),
            keepalive_timeout=IDLE_S,
            max_line_size=FIELD_BYTES,
            max_field_size=FIELD_BYTES,
            max_headers=FIELDS,
            read_bufsize=READ_BYTES,
            # No body is ever decompressed, so compressed data is refused like any malformed body.
            auto_decompress=False,
        )
        self.peer, self.places = peer, places
        self.token = ""  # digest of the token for which this connection counts
        self.opening: asyncio.Task[None] | None = None  # asyncio keeps only a weak reference
        # Ends the connection for a reason, which a WebSocket sends to its client.
        self.end: Callable[[str], None] = lambda why: self.cut()
        self._connections = connections
        self._serves, self._is_socket = False, False
        self._body: StreamReader | None = None
        self._waiting_bytes = 0

    @property
    def is_busy(self) -> bool:
        """Whether a request is being answered, or a WebSocket is open."""
        return self._serves or unsent_bytes(self.transport) > 0

    @contextmanager
    def serving(self, body: StreamReader) -> Iterator[None]:
        """Serve a request during a `with` block."""
        self._serves, self._body, self._waiting_bytes = True, body, 0
        try:
            yield
        finally:
            self._serves = False

    def become_socket(self, end: Callable[[str], None]) -> None:
        """Note that a WebSocket is open, which `end` closes with a reason."""
        self.end, self._is_socket = end, True

    def cut(self) -> None:
        cut(self.transport)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.set_write_buffer_limits(WRITE_BYTES)
        super().connection_made(transport)

    def data_received(self, data: bytes) -> None:
        # aiohttp limits how much of a body and of a WebSocket it keeps.
        in_body = self._body is not None and not self._body.is_eof()
        if not (in_body or self._is_socket):
            self._waiting_bytes += len(data)
        if self._waiting_bytes > MAX_WAITING_BYTES:
            self._connections.counts.refuse("crowded", self.peer)
            self.cut()
        else:
            super().data_received(data)

    def connection_lost(self, exc: BaseException | None) -> None:
        super().connection_lost(exc)
        self._connections.left(self)

    def handle_error(
        self,
        request: web.BaseRequest,
        status: int = 500,
        exc: BaseException | None = None,
        message: str | None = None,
    ) -> web.StreamResponse:
        if status >= 500:
            return super().handle_error(request, status, exc, message)
        nameless = (message or "").startswith("Missing 'Host'")
        self._connections.counts.refuse("host" if nameless else "malformed", self.peer)
        response = problem(
            status,
            "the request has no `Host` header, which must name the robot"
            if nameless
            else "the server received bytes that are not an HTTP request",
        )
        response.headers.update(HEADERS)
        response.force_close()
        return response
