"""The server's connections are bounded in total, from each network, and with each token."""

from __future__ import annotations

import asyncio
import socket
import ssl
from asyncio import sslproto
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import pytest
from aiohttp import web

from acsard.web import connections
from acsard.web.access import REQUEST_RATE
from acsard.web.callers import network_of
from acsard.web.connections import (
    HANDSHAKE_S,
    IDLE_S,
    MAX_CONNECTIONS,
    MAX_LOCAL,
    MAX_OF_NETWORK,
    MAX_OF_TOKEN,
    MAX_WAITING_BYTES,
    UNREAD_S,
    WRITE_BYTES,
    Connections,
    HttpConnection,
    Places,
)
from acsard.web.metrics import Counts

Handler = Callable[[web.BaseRequest], Awaitable[web.StreamResponse]]


async def _not_found(request: web.BaseRequest) -> web.Response:
    return web.Response(status=404)


@asynccontextmanager
async def accepting(
    counts: Counts, handler: Handler = _not_found, certificate: Any = None
) -> AsyncIterator[tuple[str, int]]:
    """Accept connections on loopback, and yield the address."""
    served = Connections(counts)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.setblocking(False)
        work = asyncio.create_task(served.accept(web.Server(handler), listening, certificate))
        try:
            yield listening.getsockname()
        finally:
            work.cancel()


async def is_open(reader: asyncio.StreamReader) -> bool:
    try:
        return await asyncio.wait_for(reader.read(1), 0.2) != b""
    except TimeoutError:
        return True


def test_one_name_cannot_take_all_places() -> None:
    places = Places(5, 2)
    assert [places.enter(name) for name in "aaabbcd"] == [
        True, True, False, True, True, True, False
    ]  # fmt: skip
    places.leave("b")
    assert [places.enter(name) for name in "acb"] == [False, True, False]
    assert places.taken == 5


async def test_a_connection_beyond_the_limit_is_closed_and_the_next_has_the_place_of_one_that_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(connections, "MAX_LOCAL", 3)
    counts = Counts()
    async with asyncio.timeout(20.0), accepting(counts) as (host, port):
        opened = [await asyncio.open_connection(host, port) for _ in range(4)]
        assert [await is_open(reader) for reader, _ in opened] == [True, True, True, False]
        assert counts.refused() == {"crowded": 1}
        opened[0][1].close()
        await asyncio.sleep(0.1)
        reader, writer = await asyncio.open_connection(host, port)
        writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert (await reader.readline()).split()[1] == b"404"
        late, last = await asyncio.open_connection(host, port)
        assert not await is_open(late)
        assert counts.refused() == {"crowded": 2}
        for _, each in [*opened, (reader, writer), (late, last)]:
            each.close()


async def test_a_client_that_leaves_before_it_is_accepted_does_not_end_the_server(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An `accept` also fails while the process has too many open files."""
    loop = asyncio.get_running_loop()
    accept, failures = loop.sock_accept, iter([OSError(24, "Too many open files")])

    async def failing(listening: socket.socket) -> Any:
        for error in failures:
            raise error
        return await accept(listening)

    monkeypatch.setattr(loop, "sock_accept", failing)
    async with asyncio.timeout(20.0), accepting(Counts()) as (host, port):
        reader, writer = await asyncio.open_connection(host, port)
        writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert (await reader.readline()).split()[1] == b"404"
        writer.close()


NO_BODY = Mock(is_eof=lambda: True)


class Owned:
    """The connections of one token."""

    def __init__(self, count: int) -> None:
        self.all = Connections(Counts())
        self.made = [self.new() for _ in range(count)]
        for connection in self.made:
            assert self.all.claim(connection, "phone")

    def new(self) -> HttpConnection:
        server, places = web.Server(_not_found), Places(MAX_CONNECTIONS, MAX_OF_NETWORK)
        connection = HttpConnection(self.all, server, "192.168.1.9", places)
        connection.transport = Mock(get_write_buffer_size=lambda: 0)
        return connection

    def aborted(self) -> list[HttpConnection]:
        return [one for one in self.made if cast(Mock, one.transport).abort.called]


@pytest.mark.parametrize("peer", ["192.168.1.9", "fd00:77::1"])
async def test_a_connection_that_has_left_gives_back_the_place_of_its_network(peer: str) -> None:
    """Otherwise a network that has come and gone 64 times would be locked out."""
    places, every = Places(MAX_CONNECTIONS, 1), Connections(Counts())
    assert places.enter(network_of(peer))
    connection = HttpConnection(every, web.Server(_not_found), peer, places)
    every._all.add(connection)
    every.left(connection)
    assert places.room(network_of(peer))


async def test_a_token_with_all_its_connections_loses_an_idle_one_to_a_new_one() -> None:
    """The idle connections of a phone that has changed its network must not lock it out."""
    owned = Owned(MAX_OF_TOKEN)
    with owned.made[0].serving(NO_BODY):
        newcomer = owned.new()
        assert owned.all.claim(newcomer, "phone")
        assert owned.all.claim(newcomer, "phone")  # its next request
    assert owned.aborted() == [owned.made[1]]


async def test_a_token_whose_connections_are_all_busy_gets_no_further_one() -> None:
    owned = Owned(MAX_OF_TOKEN)
    with ExitStack() as stack:
        for connection in owned.made:
            stack.enter_context(connection.serving(NO_BODY))
        assert not owned.all.claim(owned.new(), "phone")
        assert owned.all.claim(owned.new(), "tv")  # another token has its own
    assert owned.aborted() == []


async def test_a_tls_connection_that_was_closed_twice_gives_its_place_to_a_new_one() -> None:
    """A WebSocket's end closes it twice. Until it is gone, it must not fail a stop of its token."""
    owned = Owned(MAX_OF_TOKEN)
    closed = sslproto._SSLProtocolTransport(asyncio.get_running_loop(), Mock())
    closed.close()
    closed.close()
    owned.made[0].transport = closed
    assert owned.all.claim(owned.new(), "phone")


async def test_all_connections_of_a_token_end_and_a_socket_gets_the_reason() -> None:
    owned, reasons = Owned(3), list[str]()
    owned.made[1].become_socket(reasons.append)
    owned.all.end("tv", "too fast")
    owned.all.end("phone", "too fast", but=owned.made[2])
    assert owned.aborted() == [owned.made[0]]
    assert reasons == ["too fast"]


@pytest.mark.parametrize("more", ["", "X-0: " + "x" * 8000 + "\r\n"])
async def test_requests_behind_the_present_one_are_bounded(more: str) -> None:
    """Without a limit, each stranger who reads no answers costs 14 MB by 32 requests of 0.2 MB."""
    owned = Owned(1)
    (connection,) = owned.made
    request = f"GET / HTTP/1.1\r\nHost: r\r\n{more}\r\n".encode()
    with connection.serving(NO_BODY):
        for _ in range(MAX_WAITING_BYTES // len(request)):
            connection.data_received(request)
        assert owned.aborted() == []
        connection.data_received(request)
        assert owned.aborted() == [connection]
    owned = Owned(1)
    (connection,) = owned.made
    connection.data_received(b"POST / HTTP/1.1\r\nHost: r\r\nContent-Length: 500000\r\n\r\n")
    with connection.serving(Mock(is_eof=lambda: False)):  # a body, which aiohttp limits
        connection.data_received(bytes(MAX_WAITING_BYTES + 1))
    assert owned.aborted() == []


REQUEST = b"GET / HTTP/1.1\r\nHost: r\r\n"


@pytest.mark.parametrize(
    ("sent", "answer"), [(b"", b""), (REQUEST, b""), (REQUEST + b"\r\n", b"HTTP/1.1 404")]
)
async def test_a_client_that_sends_no_further_request_in_time_is_disconnected(
    monkeypatch: pytest.MonkeyPatch, sent: bytes, answer: bytes
) -> None:
    """One client sends nothing, one half of a request, and one nothing behind its request."""
    monkeypatch.setattr(connections, "IDLE_S", 0.02)
    async with asyncio.timeout(20.0), accepting(Counts()) as address:
        # The request waits already when the server accepts the connection, however busy this is.
        client = socket.create_connection(address)
        client.sendall(sent)
        client.setblocking(False)
        reader, writer = await asyncio.open_connection(sock=client)
        assert (await reader.read())[:12] == answer
        writer.close()


async def test_a_tls_handshake_that_does_not_end_in_time_is_cut_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(connections, "HANDSHAKE_S", 0.02)
    counts = Counts()
    certificate = SimpleNamespace(context=ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER))
    async with asyncio.timeout(20.0), accepting(counts, certificate=certificate) as (host, port):
        reader, writer = await asyncio.open_connection(host, port)
        assert await reader.read() == b""
        assert counts.refused() == {"slow": 1}
        writer.close()


async def test_a_client_that_leaves_its_answers_unread_is_disconnected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The kernel measures the time, which it gets in ms."""
    limits, ended = list[int](), asyncio.Event()

    async def large(request: web.BaseRequest) -> web.StreamResponse:
        assert request.transport is not None
        own = request.transport.get_extra_info("socket")
        limits.append(own.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT))
        answer = web.StreamResponse()
        await answer.prepare(request)
        try:
            while True:
                await answer.write(bytes(WRITE_BYTES))
        finally:
            ended.set()

    monkeypatch.setattr(connections, "UNREAD_S", 0.1)
    async with asyncio.timeout(20.0), accepting(Counts(), large) as (host, port):
        with socket.create_connection((host, port)) as greedy:
            greedy.sendall(REQUEST + b"\r\n")
            await ended.wait()
    assert limits == [100]


def test_the_manual_states_the_limits() -> None:
    page = Path(__file__).parents[2] / "deploy/manual/pages/reference/websocket.md"
    text = " ".join(page.read_text(encoding="utf-8").split())
    for words in (
        f"{MAX_CONNECTIONS} connections from other machines, {MAX_OF_NETWORK} of them from one",
        f"another {MAX_LOCAL} from the machine itself",
        f"A token has at most {MAX_OF_TOKEN} connections",
        f"handshake may take {HANDSHAKE_S:g} s, and each request {IDLE_S:g} s",
        f"leaves its answers unread for {UNREAD_S:g} s",
        f"{REQUEST_RATE.hz:g} requests a second, and {REQUEST_RATE.burst:g} at once",
    ):
        assert words in text
