"""Runs the page's server from start to shutdown, with its sockets, certificate and tasks."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import ssl
import sys
from collections.abc import Callable, Coroutine, Iterable, Sequence
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from typing import Any

from aiohttp import web
from msgspec import Struct

from acsard.bus.address import Address
from acsard.bus.certificate_watch import CertificateFiles
from acsard.bus.tls_files import CERTIFICATE, KEY, files_in, names_in
from acsard.bus.zenoh_sessions import client_session
from acsard.client.connection import Connection
from acsard.core.config.settings import Config
from acsard.core.values import Event
from acsard.host.child import HEARTBEAT_S, Parent, end_signals, end_with_parent
from acsard.host.logs import Log
from acsard.host.threads import NoThreadError, in_thread
from acsard.web.app import Page
from acsard.web.callers import is_loopback
from acsard.web.connections import Connections
from acsard.web.followed_robot import About, FollowedRobot
from acsard.web.listen import Listen, open_sockets, own_name, require_certificate
from acsard.web.metrics import Counts
from acsard.web.outbox import Outbox
from acsard.web.socket_messages import DEFAULT_SOURCE
from acsard.web.tokens import ReadTokens, Vault
from acsard.web.viewer import Parts

TICK_S = 1.0

# For zeros to the robot of viewers that drive, and for running requests.
SHUTDOWN_S = 0.3


class ServerOptions(Struct, frozen=True):
    """The configuration and the options of the page's server."""

    config: Config
    address: Address
    listen: tuple[Listen, ...]
    tls: str  # directory of the robot's certificate, or ""
    state: Path  # directory of the token file
    # started by the daemon: may use a later port, and ends when its standard input closes
    supervised: bool = False


async def serve(
    options: ServerOptions, announce: Callable[[Sequence[Listen]], None], log: Log
) -> None:
    """Run the page's server until a signal arrives, or until the daemon that started it ends.

    `announce` gets the addresses. Raises `MendableError` if it cannot start or connect to the bus.
    """
    # While another thread holds the interpreter lock, a command or a stop waits for 0.5 ms at most.
    sys.setswitchinterval(0.0005)
    leaving = asyncio.Event()
    for number in end_signals():
        asyncio.get_running_loop().add_signal_handler(number, leaving.set)
    if options.supervised:
        end_with_parent(signal.SIGTERM)
        # The daemon, which started this server, must have priority over it.
        os.nice(5)
    counts = Counts()
    certificate = None
    if any(address.secure for address in options.listen):
        require_certificate(options.listen, options.tls)
        certificate = Certificate(options.tls, log)
    names = set[str]() if certificate is None else certificate.names
    # People may stand in the way of a simulated robot, so only the daemon says that it is one.
    about = About.of("", simulated=False, config=options.config)
    robot = FollowedRobot(options.address, lambda: _connected(options.address), about, counts)
    parts = Parts(robot, counts)
    tokens = ReadTokens(Vault(options.state, options.address.robot_id))
    connections = Connections(counts)
    page = Page(parts, tokens, names, connections, options.config.web)
    runner = web.AppRunner(page.app, handle_signals=False, shutdown_timeout=SHUTDOWN_S)
    async with AsyncExitStack() as stack:
        await runner.setup()
        assert runner.server is not None
        stack.push_async_callback(runner.cleanup)
        work = [leaving.wait(), robot.run(), _tick(page, tokens, counts, log)]
        work.append(_read_disk(tokens, certificate))
        if options.supervised:
            work.append(_watch_parent(leaving))
        places = open_sockets(options.listen, options.supervised)
        for address, opened in places:
            stack.callback(opened.close)
            tls = certificate if address.secure else None
            work.append(connections.accept(runner.server, opened, tls))
        announce([address for address, _ in places])
        await first_ended(work, parts.outbox)
        page.end_all("the page's server ends")
        await asyncio.sleep(0)
        await asyncio.to_thread(parts.outbox.flush, SHUTDOWN_S)


async def first_ended(work: Iterable[Coroutine[Any, Any, object]], outbox: Outbox) -> None:
    """Run `work` until one of its coroutines or the outbox ends. Raises the error that ended it."""
    tasks: list[asyncio.Future[Any]] = [asyncio.create_task(coroutine) for coroutine in work]
    # The shield leaves the outbox its future: a cancelled one could not report a later error.
    tasks.append(asyncio.shield(asyncio.wrap_future(outbox.dead)))
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()


async def _tick(page: Page, tokens: ReadTokens, counts: Counts, log: Log) -> None:
    while True:
        # A revoked token ends as soon as it is read; an expired one also while a disk hangs.
        await tokens.next_reading()
        page.tidy()
        if (refusals := counts.new_refusals()) is not None:
            log.event(refusals)


async def _read_disk(tokens: ReadTokens, certificate: Certificate | None) -> None:
    def read() -> None:
        tokens.read()
        if certificate is not None:
            certificate.read()

    while True:
        # Wait without a time limit. With a limit, each attempt to read from a disk that hangs would
        # leave one more blocked thread. Only this task waits, and not the page.
        with suppress(NoThreadError):
            await in_thread(read, None)
        tokens.announce()
        await asyncio.sleep(TICK_S)


async def _watch_parent(leaving: asyncio.Event) -> None:
    parent, loop = Parent(sys.stdin.fileno()), asyncio.get_running_loop()

    def leave_if_parent_is_gone() -> None:
        if parent.is_gone():
            leaving.set()

    loop.add_reader(parent.fd, leave_if_parent_is_gone)
    try:
        while True:
            parent.beat()
            await asyncio.sleep(HEARTBEAT_S)
    finally:
        loop.remove_reader(parent.fd)


def _connected(address: Address) -> Connection:
    session = client_session(address.endpoint, address.tls)
    return Connection(session, address.robot_id, DEFAULT_SOURCE, address.tls, address.endpoint)


class Certificate:
    """The certificate of the page, and the names of the robot in it, as of the last reading."""

    def __init__(self, directory: str, log: Log) -> None:
        self._directory, self._log = directory, log
        # `CertificateFiles` records the state of the files. Create it before the files are read, so
        # that it notices every later change.
        self._files = CertificateFiles(*files_in(directory))
        self.names = set[str]()
        self.context = self._load()
        self._trouble = ""  # of the last attempt to load new files

    def read(self) -> None:
        """Load the files if they were replaced. Open connections keep the old certificate.

        A failed attempt is repeated at each call. Its cause is reported once.
        """
        if not self._files.renewed() and not self._trouble:
            return
        try:
            self.context = self._load()
        except (OSError, ValueError) as error:
            text = f"the page cannot use its new TLS certificate: {error}"
            if text != self._trouble:
                self._log.event(Event("configuration", text, "warning"))
            self._trouble = text
        else:
            self._trouble = ""
            text = "the page uses its new TLS certificate and keeps its open connections"
            self._log.info("configuration", text=text)

    def _load(self) -> ssl.SSLContext:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        where = self._directory
        context.load_cert_chain(f"{where}/{CERTIFICATE}", f"{where}/{KEY}", password="")
        names = {socket.gethostname().lower(), own_name(), *map(str.lower, names_in(where))}
        self.names |= {name for name in names if name != "localhost" and not is_loopback(name)}
        return context
