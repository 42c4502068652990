"""Runs the page's server from start to shutdown, with its sockets, certificate and tasks."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import ssl
import sys
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from typing import Any

from aiohttp import web
from msgspec import Struct

from acsard.bus.address import Address
from acsard.bus.certificate_watch import CertificateFiles
from acsard.bus.tls import CERTIFICATE, KEY, files_in, names_in
from acsard.bus.zenoh_sessions import client_session
from acsard.client import Client
from acsard.core.config.settings import Config
from acsard.core.values import Event
from acsard.host.child import HEARTBEAT_S, Parent, end_signals, end_with_parent
from acsard.host.logs import Log
from acsard.host.threads import NoThreadError, in_thread
from acsard.web.acceptor import READ_BYTES, Acceptor, Reader
from acsard.web.app import Page
from acsard.web.callers import is_loopback
from acsard.web.followed_robot import About, FollowedRobot
from acsard.web.listen import Listen, open_sockets, own_name, require_certificate
from acsard.web.metrics import Counts
from acsard.web.socket_messages import DEFAULT_SOURCE
from acsard.web.tokens import Vault
from acsard.web.viewer import Parts

TIDY_S = 1.0

# Of a request. A browser sends the cookies for all ports of a host in one header, so less could
# lock it out.
FIELD_BYTES, FIELDS = 8190, 64

# For zeros to the robot of viewers that drive, and for running requests.
SHUTDOWN_S = 0.3


class ServerOptions(Struct, frozen=True):
    """The configuration and the options of the page's server."""

    config: Config
    address: Address
    listen: tuple[Listen, ...]
    tls: str  # directory of the robot's certificate, or ""
    state: Path  # directory of the token file
    file: str | None = None  # the robot's configuration file; None for the usual places
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
    # `CertificateFiles` records the state of the files. Create it before the files are read, so
    # that it notices every later change.
    files = CertificateFiles(*files_in(options.tls))
    secure, names = _certified(options)
    robot = FollowedRobot(
        options.address, lambda: _connected(options.address), _about(options), counts
    )
    parts = Parts(robot, counts, options.file)
    vault, acceptor = Vault(options.state, options.address.robot_id), Acceptor(counts)
    page = Page(parts, vault, names, acceptor, options.config.web)
    runner = web.AppRunner(
        page.app, access_log=None, handle_signals=False, keepalive_timeout=20.0,
        shutdown_timeout=SHUTDOWN_S, max_line_size=FIELD_BYTES, max_field_size=FIELD_BYTES,
        max_headers=FIELDS, read_bufsize=READ_BYTES,
        # A body is never decompressed, so compressed data is refused like any other malformed body.
        auto_decompress=False,
    )  # fmt: skip
    async with AsyncExitStack() as stack:
        await runner.setup()
        stack.push_async_callback(runner.cleanup)
        places = open_sockets(options.listen, options.supervised)
        for address, opened in places:
            tls = secure if address.secure else None
            acceptor.listen(opened, tls, lambda: Reader(counts, runner.server))
        stack.callback(acceptor.close)
        announce([address for address, _ in places])
        stack.callback(asyncio.create_task(_report_refusals(counts, log)).cancel)
        if secure is not None:
            renewing = _renew(secure, names, files, options.tls, log)
            stack.callback(asyncio.create_task(renewing).cancel)
        await _until(leaving, parts, page, options)
        page.end_all("the page's server ends")
        await asyncio.sleep(0)
        await asyncio.to_thread(parts.commands.outbox.flush, SHUTDOWN_S)


async def _until(leaving: asyncio.Event, parts: Parts, page: Page, options: ServerOptions) -> None:
    work: list[asyncio.Future[Any]] = [
        asyncio.create_task(leaving.wait()),
        asyncio.create_task(parts.robot.run()),
        asyncio.create_task(_tidy(page)),
        asyncio.wrap_future(parts.commands.outbox.dead),
    ]
    if options.supervised:
        work.append(asyncio.create_task(_watch_parent(leaving)))
    try:
        done, _ = await asyncio.wait(work, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()  # raises the error that ended it
    finally:
        for task in work:
            task.cancel()


async def _tidy(page: Page) -> None:
    while True:
        await asyncio.sleep(TIDY_S)
        await page.tidy()


async def _report_refusals(counts: Counts, log: Log) -> None:
    while True:
        await asyncio.sleep(TIDY_S)
        if (refusals := counts.new_refusals()) is not None:
            log.event(refusals)


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


def _connected(address: Address) -> Client:
    session = client_session(address.endpoint, address.tls)
    return Client(session, address.robot_id, DEFAULT_SOURCE, address.tls, address.endpoint)


def _about(options: ServerOptions) -> About:
    config = options.config
    return About(
        "",
        config.mcu.simulated,
        config.limits.linear_speed,
        config.limits.angular_speed,
        config.rates.state_hz,
        config.record.directory,
        {source.name: source.timeout for source in config.commands.sources},
    )


def _certified(options: ServerOptions) -> tuple[ssl.SSLContext | None, set[str]]:
    if not any(address.secure for address in options.listen):
        return None, set()
    require_certificate(options.listen, options.tls)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    _load(context, options.tls)
    return context, _names(options.tls)


def _load(context: ssl.SSLContext, directory: str) -> None:
    context.load_cert_chain(f"{directory}/{CERTIFICATE}", f"{directory}/{KEY}", password="")


def _names(directory: str) -> set[str]:
    names = {socket.gethostname().lower(), own_name(), *map(str.lower, names_in(directory))}
    return {name for name in names if name != "localhost" and not is_loopback(name)}


async def _renew(
    context: ssl.SSLContext, names: set[str], files: CertificateFiles, directory: str, log: Log
) -> None:
    renewed, reported = False, ""
    while True:
        await asyncio.sleep(TIDY_S)
        # Wait without a time limit. With a limit, each attempt to read from a disk that hangs would
        # leave one more blocked thread. Only this task waits, and not the page.
        with suppress(NoThreadError):
            renewed = await in_thread(files.renewed, None) or renewed
        if not renewed:
            continue
        try:
            _load(context, directory)
            names |= _names(directory)
        except (OSError, ValueError) as error:
            # The files may just be in the process of being replaced. The next round tries again.
            text = f"the page cannot use its new TLS certificate yet: {error}"
            if text != reported:
                log.event(Event("configuration", text, "warning"))
            reported = text
            continue
        renewed, reported = False, ""
        log.info(
            "configuration",
            text="the page uses its new TLS certificate and keeps its open connections",
        )
