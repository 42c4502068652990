"""Accepts TCP connections, and cuts connections beyond the limits before they use much memory.

A silent connection, from which no byte has arrived, costs only a file descriptor and an entry in
`Sockets`, because TLS starts with the first byte. Then it waits until its TLS handshake may start:
too many may run, or its network may have started them too often. At the end, aiohttp reads its
requests.
"""

from __future__ import annotations

import asyncio
import errno
import resource
import socket
import ssl
import traceback
from asyncio import sslproto
from collections import Counter
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Any, Literal, NamedTuple

from aiohttp import StreamReader, web, web_protocol
from aiohttp.web_protocol import RequestHandler

from acsard.host import clock
from acsard.host.rate_limits import Buckets
from acsard.web.answers import HEADERS, cut, problem
from acsard.web.callers import AdmittedClient, is_loopback, network_of, unmapped
from acsard.web.limits import (
    HANDSHAKE_RATE,
    MAX_LOCAL_TCP_CONNECTIONS,
    MAX_UNREAD_BYTES,
    Sockets,
    sockets_for,
)
from acsard.web.metrics import Counts

# Time limit of one TLS handshake, and most handshakes at the same time.
HANDSHAKE_S, HANDSHAKES_AT_ONCE = 3.0, 32

# An older handshake may be aborted for one that waits. Otherwise clients that stop sending would
# delay a phone's handshake by up to `HANDSHAKE_S`.
MIN_ABORT_AGE_S = 0.3

# From accepting a connection to the end of the headers of its first request.
REQUEST_TIMEOUT_S = 10.0

# The kernel then ends a connection whose client acknowledges no data or keeps its window closed.
UNREAD_TIMEOUT_S = 5.0

# Read buffer of each TLS connection: it holds one TLS record. asyncio's default is 256 KiB.
READ_BYTES = 16384

# The server accepts no connections for this time when the process has no free file descriptor.
NO_FILES_PAUSE_S = 0.05

Factory = Callable[[], "Reader"]


class _Listener(NamedTuple):
    opened: socket.socket
    secure: ssl.SSLContext | None
    make: Factory


class Acceptor:
    """Accepts TCP connections at the listening addresses, and cuts connections beyond the limits.

    Connections from the robot itself have a separate limit, so clients on other machines cannot
    lock out a browser on the robot.
    """

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        self._here = Sockets["_Connection"](MAX_LOCAL_TCP_CONNECTIONS)
        self._away = Sockets["_Connection"](sockets_for(files))
        self._listeners: list[_Listener] = []
        # Connections that wait for their handshake, by network. The networks take turns: one whose
        # handshake starts moves to the end.
        self._waiting: dict[str, dict[_Connection, None]] = {}
        self._handshakes = Buckets(HANDSHAKE_RATE)
        # Start time of each running handshake on the event loop's clock, oldest first.
        self._starting: dict[_Connection, float] = {}
        self._again: asyncio.TimerHandle | None = None  # timer of the next call of `_next`
        # connections without a valid token at the last call of `tidy()`
        self._ended: set[_Connection] = set()

    def listen(self, opened: socket.socket, secure: ssl.SSLContext | None, make: Factory) -> None:
        """Accept connections at a socket; `make` creates the HTTP handler of each."""
        sslproto.SSLProtocol.max_size = READ_BYTES
        # A browser waits for the answer before it sends the next request on a connection. aiohttp
        # would queue 32 requests, whose headers can take megabytes.
        web_protocol.MAX_MSG_QUEUE_SIZE = 1
        listener = _Listener(opened, secure, make)
        self._listeners.append(listener)
        self._resume(listener)

    def close(self) -> None:
        """Stop accepting connections, and cut those of unidentified clients."""
        loop = asyncio.get_running_loop()
        for listener in self._listeners:
            loop.remove_reader(listener.opened)
            listener.opened.close()
        self._listeners.clear()
        for pool in (self._here, self._away):
            for connection in pool.strangers():
                connection.cut()

    def spoke(self, transport: asyncio.BaseTransport | None, body: StreamReader) -> None:
        """Stop the timer of the request headers, which have arrived.

        `body` is the stream of the body.
        """
        if (connection := _connection(transport)) is not None:
            connection.spoke(body)

    def admitted(self, transport: asyncio.BaseTransport | None, identity: AdmittedClient) -> None:
        """Record who the client of a connection is.

        Unidentified clients make room for others first.
        """
        if (connection := _connection(transport)) is not None:
            connection.pool.prove(connection, identity.token)

    def tidy(self, valid: Collection[str]) -> None:
        """Close the connections that have had no valid token at two calls. Call this once a second.

        In between, the server can tell a WebSocket client why the connection ends. `valid` has the
        digests of all valid tokens.
        """
        before = self._ended
        self._ended = {
            connection for pool in (self._here, self._away) for connection in pool.ended(valid)
        }
        for connection in self._ended & before:
            connection.cut()

    def _resume(self, listener: _Listener) -> None:
        if listener in self._listeners:
            asyncio.get_running_loop().add_reader(listener.opened, self._accept, listener)

    def _accept(self, listener: _Listener) -> None:
        # Accept at most 32 connections in a row, so that other work of the event loop has its turn.
        for _ in range(32):
            try:
                accepted, place = listener.opened.accept()
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
                    self._no_file(listener)
                    return
                continue  # the client has gone already
            peer = unmapped(str(place[0]))
            pool = self._here if is_loopback(peer) else self._away
            _Connection(self, pool, accepted, peer, listener).enter()

    def _no_file(self, listener: _Listener) -> None:
        loop = asyncio.get_running_loop()
        loop.remove_reader(listener.opened)
        loop.call_later(NO_FILES_PAUSE_S, self._resume, listener)
        if (victim := self._away.displaced() or self._here.displaced()) is not None:
            self.refuse(victim, "crowded")

    # The connections call the methods below.

    def refuse(self, connection: _Connection, reason: Literal["crowded", "slow"]) -> None:
        """Cut a connection, and count the refusal.

        The reason is "slow" if the connection exceeds a time limit. It is "crowded" if there is no
        room for the connection, or if its request headers are too long.
        """
        self._counts.refuse(reason, connection.peer)
        connection.cut()

    def wait(self, connection: _Connection) -> None:
        """Queue a connection. Its TLS handshake starts as soon as the limits allow it."""
        self._waiting.setdefault(connection.network, {})[connection] = None
        if self._again is None:
            self._next()

    def give_up(self, connection: _Connection) -> None:
        """Remove a connection from the queue of connections that wait for their TLS handshake."""
        same = self._waiting.get(connection.network, {})
        same.pop(connection, None)
        if not same:
            self._waiting.pop(connection.network, None)

    def started(self, connection: _Connection) -> None:
        """Record that the TLS handshake of the connection `connection` has succeeded or failed.

        If another handshake is waiting and the limits allow it, start that handshake.
        """
        self._starting.pop(connection, None)
        if self._again is None:
            self._next()

    def _next(self) -> None:
        loop, self._again = asyncio.get_running_loop(), None
        if not self._waiting:
            return
        now_ns = clock.mono_ns()
        begun = Counter(connection.network for connection in self._starting)
        # A network with many handshakes must not delay the handshakes of other networks.
        ready = [name for name in self._waiting if self._handshakes.room(name, now_ns)]
        if ready and self._has_room(loop.time()):
            network = min(ready, key=lambda name: begun[name])
            self._handshakes.take(network, now_ns)
            same = self._waiting.pop(network)
            connection = next(iter(same))
            del same[connection]
            if same:
                self._waiting[network] = same  # after all other networks
            self._starting[connection] = loop.time()
            connection.start()
        # A handshake occupies the event loop for 1 to 2 ms. The pause between the handshakes lets
        # the server send a stop before the next one.
        self._again = loop.call_later(0.005, self._next)

    def _has_room(self, now: float) -> bool:
        if len(self._starting) < HANDSHAKES_AT_ONCE:
            return True
        # Only the network with the most handshakes loses one. So a slow client in another network
        # can finish its handshake.
        networks = Counter(connection.network for connection in self._starting)
        most = max(networks.values())
        oldest, begun = next(
            item for item in self._starting.items() if networks[item[0].network] == most
        )
        if now < begun + MIN_ABORT_AGE_S:
            return False
        del self._starting[oldest]
        self.refuse(oldest, "slow")
        return True


class _Connection(asyncio.Protocol):
    def __init__(
        self,
        acceptor: Acceptor,
        pool: Sockets[_Connection],
        accepted: socket.socket,
        peer: str,
        listener: _Listener,
    ) -> None:
        self.pool, self.peer, self.network = pool, peer, network_of(peer)
        self._acceptor, self._socket = acceptor, accepted
        self._secure, self._make = listener.secure, listener.make
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._task: asyncio.Task[None] | None = None
        self._transport: asyncio.BaseTransport | None = None
        self._head = 0  # bytes of the present request line and headers so far
        self._body: StreamReader | None = None
        self._inner: Reader | None = None

    def enter(self) -> None:
        victim = self.pool.enter(self.network, self)
        if victim is self:
            self._acceptor.refuse(self, "crowded")
            return
        if victim is not None:
            self._acceptor.refuse(victim, "crowded")
        self._socket.setblocking(False)
        option, unread_ms = socket.TCP_USER_TIMEOUT, round(1000 * UNREAD_TIMEOUT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, option, unread_ms)
        self._timer = self._loop.call_later(REQUEST_TIMEOUT_S, self._acceptor.refuse, self, "slow")
        self._loop.add_reader(self._socket, self._first_byte)

    def _first_byte(self) -> None:
        try:
            first = self._socket.recv(1, socket.MSG_PEEK)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            first = b""
        if not first:
            self.cut()
            return
        self._loop.remove_reader(self._socket)
        if self._secure is None:
            self.start()
        else:
            self._acceptor.wait(self)

    def start(self) -> None:
        self._task = self._loop.create_task(self._open())

    async def _open(self) -> None:
        secure = self._secure
        try:
            await self._loop.connect_accepted_socket(
                lambda: self,
                self._socket,
                ssl=secure,
                ssl_handshake_timeout=HANDSHAKE_S if secure else None,
                ssl_shutdown_timeout=1.0 if secure else None,
            )
        except OSError as error:
            # The frames of the traceback would keep the TLS buffers in memory until the next
            # garbage collection.
            traceback.clear_frames(error.__traceback__)
            if isinstance(error, ConnectionAbortedError):
                self._acceptor.refuse(self, "slow")  # `HANDSHAKE_S` is over
            # Otherwise the client does not speak TLS, or does not trust the certificate.
        finally:
            if secure is not None:
                self._acceptor.started(self)
            if self._transport is None:
                self._leave()

    def cut(self) -> None:
        self._leave()
        if self._transport is not None:
            cut(self._transport)
        elif self._task is None:
            self._acceptor.give_up(self)
            self._loop.remove_reader(self._socket)
            self._socket.close()
        else:
            # The handshake ends with an error, and its transport closes the socket.
            with suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)

    def spoke(self, body: StreamReader) -> None:
        """Record that the headers of a request have arrived, and stop the timer for them."""
        self._head, self._body = 0, body
        self._cancel_timer()

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def _leave(self) -> None:
        self._cancel_timer()
        self.pool.leave(self)

    # The transport calls the methods below.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport
        transport.set_write_buffer_limits(MAX_UNREAD_BYTES)  # type: ignore[attr-defined]
        if self._secure is not None:
            transport.set_read_buffer_limits(READ_BYTES)  # type: ignore[attr-defined]
        self._inner = self._make()
        self._inner.connection_made(transport)

    def data_received(self, data: bytes) -> None:
        if self._inner is None:
            return
        in_body = self._body is not None and not self._body.is_eof()
        self._inner.data_received(data)
        if in_body or not self._inner.reads_head:
            self._head = 0
            return
        self._head += len(data)
        # Headers that never end would fill the memory.
        if self._head > 131072:
            self._acceptor.refuse(self, "crowded")

    def eof_received(self) -> None:
        if self._inner is not None:
            self._inner.eof_received()

    def pause_writing(self) -> None:
        if self._inner is not None:
            self._inner.pause_writing()

    def resume_writing(self) -> None:
        if self._inner is not None:
            self._inner.resume_writing()

    def connection_lost(self, error: Exception | None) -> None:
        self._leave()
        if self._inner is not None:
            self._inner.connection_lost(error)


def _connection(transport: asyncio.BaseTransport | None) -> _Connection | None:
    protocol = None if transport is None else transport.get_protocol()
    return protocol if isinstance(protocol, _Connection) else None


class Reader(RequestHandler):
    """aiohttp's handler of one connection, which answers invalid requests with JSON errors."""

    def __init__(self, counts: Counts, server: Any) -> None:
        super().__init__(server, loop=server._loop, **server._kwargs)
        self._counted = counts

    @property
    def reads_head(self) -> bool:
        """Whether the next bytes belong to the head of a request.

        This is not so on a WebSocket, nor while a request waits for its handler.
        """
        return not self._upgraded and not self._messages

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
        peer = unmapped(request.remote or "")
        self._counted.refuse("host" if nameless else "malformed", peer)
        response = problem(
            status,
            "the request has no `Host` header, which must name the robot"
            if nameless
            else "the server received bytes that are not an HTTP request",
        )
        response.headers.update(HEADERS)
        response.force_close()
        return response
