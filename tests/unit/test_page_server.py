"""The page's server listens where it says, and reads tokens and certificates again."""

from __future__ import annotations

import _thread
import asyncio
import io
import os
import signal
import socket
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import aiohttp
import pytest
from msgspec.structs import replace

from acsard.bus import certificate_watch
from acsard.bus.address import Address
from acsard.bus.tls_files import KEY
from acsard.cli import main, parser, web
from acsard.core.config.settings import Config, LogConfig
from acsard.host.errors import CertificateError, InUseError, UsageError
from acsard.host.logs import Log
from acsard.host.own_identity import own_addresses
from acsard.machine.authority import Authority
from acsard.web import page_server
from acsard.web.listen import (
    Listen,
    invitations,
    open_sockets,
    own_name,
    parse_listen,
    require_certificate,
)
from acsard.web.metrics import Counts
from acsard.web.page_server import Certificate, ServerOptions
from acsard.web.tokens import ReadTokens, Vault
from tests.unit.screens import STATE, sample_of
from tests.unit.test_page_robot import AnsweringRobot

OWN = [*own_addresses(), "203.0.113.9", "2001:db8::9"]


@pytest.fixture
def tls(tmp_path: Path) -> str:
    """Make a certificate for all addresses of this machine and for some that it does not have."""
    Authority.make(tmp_path / "tls", "test", 1, OWN).issue(tmp_path / "tls", "robot", OWN, 1)
    return str(tmp_path / "tls")


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def reached(port: int, host: str) -> bool:
    try:
        socket.create_connection((host, port), 5.0).close()
    except OSError:
        return False
    return True


def test_an_address_is_parsed_and_a_remote_one_must_be_https() -> None:
    assert parse_listen("http://127.0.0.1:8080") == Listen(False, "127.0.0.1", 8080)
    assert parse_listen("https://[::]:8443/") == Listen(True, "::", 8443)
    assert parse_listen("https://[::]:8443").url == f"https://{own_name()}:8443/"
    for wrong in ("127.0.0.1:8080", "http://:80", "http://127.0.0.1:0", "ftp://a:1", "https://a:x"):
        with pytest.raises(UsageError, match="is not an address"):
            parse_listen(wrong)
    with pytest.raises(UsageError, match="use https"):
        parse_listen("http://0.0.0.0:8080")


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_an_invitation_has_the_certified_addresses_at_which_the_server_listens(
    host: str, tls: str
) -> None:
    urls = invitations([Listen(True, host, 8443), Listen(False, "127.0.0.1", 8080)], tls)
    older = [at for at in own_addresses() if ":" not in at]
    newer = [f"[{at}]" for at in own_addresses() if ":" in at and host == "::"]
    assert urls == [f"https://{at}:8443/" for at in (*older, *newer, own_name())]


def test_the_lines_at_the_start_name_each_page_and_the_manual_that_it_serves() -> None:
    wished, other = Listen(False, "127.0.0.1", 8080), Listen(False, "127.0.0.1", 8081)
    assert list(web.places([wished], [wished], "", with_manual=False)) == [
        "page ready  http://127.0.0.1:8080/"
    ]
    *_, manual = web.places([wished, other], [wished, other], "", with_manual=True)
    assert manual == "manual      http://127.0.0.1:8080/docs"
    page, manual = web.places([other], [wished], "", with_manual=True)
    assert page.startswith("page ready  http://127.0.0.1:8081/  (instead of http://127.0.0.1:8080/")
    assert manual == "manual      http://127.0.0.1:8081/docs"


@pytest.mark.parametrize(("host", "by"), [("0.0.0.0", {"127.0.0.1"}), ("::", {"127.0.0.1", "::1"})])
def test_a_wildcard_address_is_reached_by_ipv4_and_only_the_ipv6_one_by_ipv6(
    host: str, by: set[str]
) -> None:
    [(endpoint, opened)] = open_sockets([Listen(True, host, free_port())], next_port=False)
    with opened:
        assert {at for at in ("127.0.0.1", "::1") if reached(endpoint.port, at)} == by


def test_a_port_in_use_is_reported_or_the_next_port_is_used() -> None:
    with socket.socket() as occupant:
        occupant.bind(("127.0.0.1", 0))
        occupant.listen()
        wished = Listen(False, "127.0.0.1", occupant.getsockname()[1])
        with pytest.raises(
            InUseError, match=r"cannot listen at \S+: Address already in use; if .* choose another"
        ):
            open_sockets([wished], next_port=False)
        [(endpoint, opened)] = open_sockets([wished], next_port=True)
        with opened:
            assert endpoint.port > wished.port


def test_a_name_that_no_resolver_knows_is_reported_in_the_words_of_the_system(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(InUseError, match="https://robot7:8443/: Name or service not known; if"):
        open_sockets([Listen(True, "robot7", 8443)], next_port=False)


@pytest.mark.parametrize("texts", [("0.0.0.0", "[::]"), ("[::]", "127.0.0.1")])
def test_an_address_at_the_port_of_the_ipv6_wildcard_is_reported(
    texts: tuple[str, str],
) -> None:
    port = free_port()
    with pytest.raises(UsageError, match=rf"^\[::\]:{port} .* IPv4 too: list it alone, without \d"):
        open_sockets([parse_listen(f"https://{text}:{port}") for text in texts], next_port=True)


def test_https_without_a_certificate_is_reported_and_http_needs_none(tmp_path: Path) -> None:
    away, here = parse_listen("https://0.0.0.0:8443"), parse_listen("http://127.0.0.1:8080")
    require_certificate([here], "")
    with pytest.raises(CertificateError, match="tls init"):
        require_certificate([here, away], "")
    with pytest.raises(CertificateError, match="tls init"):
        require_certificate([away], str(tmp_path))


@pytest.mark.parametrize("tls", [(), ("--tls", "nowhere")])
def test_an_invitation_is_refused_if_the_server_could_not_start(
    tmp_path: Path, tls: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    words = ["web", *tls, "--address", "https://0.0.0.0:8443", "invite", "viewer"]
    with pytest.raises(CertificateError, match="tls init"):
        web.main_invite(parser(["web"]).parse_args(words))
    assert list(tmp_path.iterdir()) == []


def test_an_invitation_ends_with_the_command_that_revokes_it(
    tls: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    address = ["--address", "https://0.0.0.0:8443"]
    assert main(["web", "--tls", tls, *address, "invite", "viewer", "--name", "tv"]) == 0
    _, _, command = capsys.readouterr().out.partition("before that: acsard ")
    assert main(command.splitlines()[0].split()) == 0
    assert capsys.readouterr().out == "tv is revoked\n"
    assert Vault(tmp_path / "state", "acsar").all() == []


async def test_one_thread_waits_for_a_hanging_disk_and_then_everything_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_server, "TICK_S", 0.01)
    monkeypatch.setattr(certificate_watch, "FILES_CHECK_PERIOD_NS", 0)
    authority, key = Authority.make(tmp_path, "test", 10), tmp_path / KEY
    authority.issue(tmp_path, "robot", ["192.168.0.1"], 10)
    log, vault = Log(LogConfig(), io.StringIO()), Vault(tmp_path / "state", "acsar")
    text, _ = vault.invite("viewer", "tv", 1)
    tokens, certificate = ReadTokens(vault), Certificate(str(tmp_path), log)
    before = certificate.context
    reading = asyncio.create_task(page_server._read_disk(tokens, certificate))
    try:
        await tokens.next_reading()
        assert tokens.owner([text]) is not None
        # A read of a named pipe blocks until another program has written to the pipe.
        threads = _thread._count()
        key.unlink()
        os.mkfifo(key)
        await asyncio.sleep(0.5)  # fifty attempts, if each had a thread
        assert _thread._count() <= threads + 1
        assert tokens.owner([text]) is not None
        vault.revoke("tv")
        hanging = os.open(key, os.O_WRONLY)
        key.unlink()
        authority.issue(tmp_path, "robot", ["192.168.0.2"], 10)
        os.close(hanging)
        async with asyncio.timeout(20.0):
            while "192.168.0.2" not in certificate.names or tokens.owner([text]):
                await asyncio.sleep(0.01)
        assert certificate.context is not before
    finally:
        reading.cancel()
        log.close()


def test_the_page_keeps_its_certificate_until_the_new_one_is_whole_and_then_reports_it_once(
    tls: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(certificate_watch, "FILES_CHECK_PERIOD_NS", 0)
    out = io.StringIO()
    log = Log(LogConfig(), out)
    certificate, key = Certificate(tls, log), Path(tls) / KEY
    before, good = certificate.context, key.read_bytes()
    key.write_bytes(b"damaged")
    for _ in range(3):
        certificate.read()
    assert certificate.context is before
    key.write_bytes(good)
    for _ in range(3):
        certificate.read()
    assert certificate.context is not before
    log.close()
    assert out.getvalue().count("TLS certificate") == 1
    assert "uses its new TLS certificate and keeps" in out.getvalue()


async def test_the_connections_of_a_revoked_token_end_with_the_reading_that_misses_it(
    tmp_path: Path,
) -> None:
    log, vault = Log(LogConfig(), io.StringIO()), Vault(tmp_path, "acsar")
    text, _ = vault.invite("viewer", "tv", 1)
    tokens, valid = ReadTokens(vault), list[bool]()
    page: Any = SimpleNamespace(tidy=lambda: valid.append(tokens.owner([text]) is not None))
    ticking = asyncio.create_task(page_server._tick(page, tokens, Counts(), log))
    try:
        await asyncio.sleep(0)
        for revokes in (False, True):
            if revokes:
                vault.revoke("tv")
            tokens.read()
            tokens.announce()
            await asyncio.sleep(0.01)
        assert valid == [True, False]
    finally:
        ticking.cancel()
        log.close()


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ServerOptions]:
    """Return the options of a server whose robot answers."""
    client = AnsweringRobot(failures=0)
    client.queue.append(sample_of(STATE))
    monkeypatch.setattr(page_server, "_connected", lambda _: client)
    monkeypatch.setattr(page_server, "TICK_S", 0.01)
    monkeypatch.setattr(os, "nice", lambda _: 0)
    monkeypatch.setattr(page_server, "end_with_parent", lambda _: None)
    before = sys.getswitchinterval()
    where = Address("tcp/127.0.0.1:1", "acsar", "")
    listen = (Listen(False, "127.0.0.1", free_port()),)
    yield ServerOptions(Config(), where, listen, "", tmp_path / "state")
    sys.setswitchinterval(before)


async def fetched(listen: Sequence[Listen]) -> int:
    async with aiohttp.ClientSession() as session, session.get(listen[0].url) as answer:
        return answer.status


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
async def test_a_signal_ends_the_server_of_the_page_and_its_websockets(
    number: signal.Signals, served: ServerOptions
) -> None:
    log, ready = Log(LogConfig(), io.StringIO()), asyncio.Queue[Sequence[Listen]]()
    serving = asyncio.create_task(page_server.serve(served, ready.put_nowait, log))
    async with asyncio.timeout(20.0):
        listen = await ready.get()
        assert list(listen) == list(served.listen)
        assert await fetched(listen) == 200
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{listen[0].url}ws") as theirs,
        ):
            os.kill(os.getpid(), number)
            while (message := await theirs.receive()).type == aiohttp.WSMsgType.TEXT:
                pass
        assert message.extra == "the page's server ends"
        await serving
    assert not reached(listen[0].port, listen[0].host)
    log.close()


async def test_the_server_of_the_page_ends_with_the_daemon_that_started_it(
    served: ServerOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, ready = Log(LogConfig(), io.StringIO()), asyncio.Queue[Sequence[Listen]]()
    daemon, child = socket.socketpair()
    daemon.setblocking(False)
    monkeypatch.setattr(sys, "stdin", child)
    options = replace(served, supervised=True)
    serving = asyncio.create_task(page_server.serve(options, ready.put_nowait, log))
    async with asyncio.timeout(20.0):
        assert await fetched(await ready.get()) == 200
        assert await asyncio.get_running_loop().sock_recv(daemon, 1) == b"."  # a sign of life
        assert not serving.done()
        daemon.close()
        await serving
    log.close()
    child.close()


@pytest.mark.parametrize("part", ["task", "outbox"])
async def test_an_error_of_a_part_ends_the_server_with_that_error(part: str) -> None:
    cancelled, outbox = asyncio.Event(), SimpleNamespace(dead=Future[None]())

    async def waits() -> None:
        try:
            await asyncio.sleep(60.0)
        finally:
            cancelled.set()

    async def fails() -> None:
        if part == "outbox":
            outbox.dead.set_exception(UsageError("it fails"))
            await asyncio.sleep(60.0)
        raise UsageError("it fails")

    with pytest.raises(UsageError, match="it fails"):
        await page_server.first_ended([waits(), fails()], cast(Any, outbox))
    async with asyncio.timeout(20.0):
        await cancelled.wait()
