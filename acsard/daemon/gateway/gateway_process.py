"""Runs the TLS gateway's Zenoh session in a separate process that can be restarted.

A malicious client can make Zenoh compare key expressions for ever, use all connections or much
memory: this process suffers, the daemon does not. A call to Zenoh may then never return, so a
thread observes the session, and the main thread checks that observations keep coming.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import signal
import threading
from functools import partial

import zenoh

from acsard.core.values import Event
from acsard.daemon.gateway.session_health import Observation, SessionHealth
from acsard.daemon.gateway.tls_gateway import Gateway
from acsard.host import clock
from acsard.host.child import Parent, end_signals, end_with_parent
from acsard.host.errors import Exit
from acsard.host.logs import Log
from acsard.host.systemd import Systemd
from acsard.host.threads import Worker

CHECK_PERIOD_S = 0.25  # of observations, and of the main thread's check

# It needs 35 MB, or 72 MB with all connections. An attack uses 600 MB in a second, too fast for a
# check, so the kernel refuses more, which ends the process.
MAX_MEMORY_BYTES = 192 << 20


class GatewayProcess:
    """The main loop of the process, until it must end or be restarted."""

    def __init__(self, gateway: Gateway, log: Log, manager: Systemd, parent: int | None) -> None:
        # The process ends when the parent closes its end of `parent`; a socket gets signs of life.
        self._gateway, self._log, self._manager = gateway, log, manager
        self._parent = None if parent is None else Parent(parent)
        self._session: zenoh.Session | None = None  # never closed, because that could take for ever
        self._observed = Observation(0)
        self._error: BaseException | None = None
        self._leaving = False

    def run(self) -> Exit:
        """Run until the process must end; FAILURE asks for a restart.

        Raises an exception of the observing thread.
        """
        for number in end_signals():
            signal.signal(number, self._leave)
        if self._parent is not None:
            end_with_parent(signal.SIGKILL)
        _confine()
        self._manager.ready()
        while not self._gateway.ready():
            self._manager.status("waits for the daemon")
            if self._wait():
                return Exit.OK
        health = self._open()
        before_ns = clock.mono_ns()
        while not self._wait():
            if self._error is not None:
                raise self._error
            now_ns = clock.mono_ns()
            event = health.restart_event(self._observed, now_ns - before_ns)
            if event is not None:
                self._log.event(event)
                return Exit.FAILURE
            if self._renewed():
                text = (
                    "this process restarts with its new certificate, which disconnects all clients"
                )
                self._log.info("gateway_open", text=text)
                return Exit.FAILURE
            before_ns = now_ns
        return Exit.OK

    def _renewed(self) -> bool:
        # There is a new certificate.
        files = self._gateway.files
        if not files.renewed():
            return False
        why = files.refused()
        if why:
            text = (
                "this process goes on with its old certificate, because it cannot use the new one: "
                f"{why}"
            )
            self._log.event(Event("gateway_open", text, "warning"))
        return not why

    def _leave(self, *_: object) -> None:
        self._leaving = True

    def _wait(self) -> bool:
        # Wait for `CHECK_PERIOD_S`; True: the process must end.
        self._manager.alive()
        parent = self._parent
        if parent is None:
            select.select([], [], [], CHECK_PERIOD_S)
            return self._leaving
        parent.beat()
        readable, _, _ = select.select([parent.fd], [], [], CHECK_PERIOD_S)
        return self._leaving or (bool(readable) and parent.is_gone())

    def _open(self) -> SessionHealth:
        gateway = self._gateway
        session = self._session = gateway.open()
        opened_ns = clock.mono_ns()
        self._observed = Observation(opened_ns)
        health = SessionHealth(gateway.most, opened_ns)
        Worker("observe", partial(self._observe, session, health), self._fail).start()
        self._log.info("gateway_open", text=f"listens at {gateway.where}")
        self._manager.status(f"open at {gateway.where}")
        return health

    def _observe(self, session: zenoh.Session, health: SessionHealth) -> None:
        pause = threading.Event()
        while True:
            observed = self._observed = self._gateway.observe(session)
            event = health.full_event(observed)
            if event is not None:
                self._log.event(event)
            self._gateway.report(session, observed, health)
            pause.wait(CHECK_PERIOD_S)

    def _fail(self, error: BaseException) -> None:
        self._error = error  # raised by `run`, which ends the process


def _confine() -> None:
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with contextlib.suppress(OSError):
        os.nice(5)  # the daemon and ordinary programs have priority over this process
    # If a lack of memory ends the process, a backtrace would only fill the log.
    os.environ["RUST_BACKTRACE"] = "0"
