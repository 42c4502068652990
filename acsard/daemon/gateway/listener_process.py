"""Runs a Zenoh session that is open to strangers, in a process of its own that may be restarted.

A stranger can make Zenoh compare key expressions for ever, keep all connections, or take memory.
All of that happens in this process, and not in the daemon. During such an attack a call to Zenoh
may never return. Therefore one thread observes the session, and the main thread checks whether that
thread still does so.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import signal
import threading
from typing import Protocol

import zenoh

from acsard.core.values import Event
from acsard.daemon.gateway.session_health import Events, Observation, SessionHealth
from acsard.host import clock
from acsard.host.child import Parent, end_with_parent
from acsard.host.errors import Exit
from acsard.host.logs import Log
from acsard.host.systemd import Systemd

PERIOD_S = 0.25
"""Time between two observations of the session, and between two checks."""

MEMORY_BYTES = 192 << 20
"""Memory limit of the process, which takes 35 MB, or 72 MB with all connections in use.

An attack takes 600 MB a second, faster than any check could react. The kernel then refuses the
memory, which ends the process.
"""

NICE = 5
"""Niceness, so that the daemon and the programs of people run before this process."""


class Listener(Protocol):
    """A session that listens to the network: the TLS gateway, or the router of a fleet."""

    where: str
    """Addresses at which the session listens, separated by commas."""
    most: int
    """Largest number of connections from the network."""
    events: Events
    """Names of the log events."""

    def ready(self) -> bool:
        """Return whether clients may be admitted now."""

    def open(self) -> zenoh.Session:
        """Open the session and listen. This call blocks."""

    def observe(self, session: zenoh.Session) -> Observation:
        """Return the state of the session. This call may never return."""

    def renewed(self) -> bool:
        """Return whether the session must be opened again, because it has a new certificate."""

    def refused(self) -> str:
        """Return why a session cannot be opened with the new certificate, or "" if it can."""

    def report(self, session: zenoh.Session, observed: Observation, health: SessionHealth) -> None:
        """Publish the state for the daemon, if there is one. This call may never return."""


class ListenerProcess:
    """The process of one listener, from its start to its end or its next restart."""

    def __init__(self, listener: Listener, log: Log, manager: Systemd, parent: int | None) -> None:
        """Prepare the process.

        `parent` is a file descriptor that the parent process holds, or None. The process ends when
        the parent closes it. If it is a socket, the process writes a sign of life to it in every
        period.
        """
        self._listener, self._log, self._manager = listener, log, manager
        self._parent = None if parent is None else Parent(parent)
        self._session: zenoh.Session | None = None
        """The session is never closed, because closing it could take for ever."""
        self._observed = Observation(0)
        self._error: BaseException | None = None
        self._leaving = False

    def run(self) -> Exit:
        """Run until the process must end.

        Returns OK after a signal or the end of the parent, and FAILURE if the process must be
        started again.
        """
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, self._leave)
        if self._parent is not None:
            end_with_parent(signal.SIGKILL)
        _confine()
        self._manager.ready()
        while not self._listener.ready():
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
            if self._listener.renewed() and not self._refused():
                text = "opens again with its new certificate; all clients are disconnected"
                self._log.info(self._listener.events["open"], text=text)
                return Exit.FAILURE
            before_ns = now_ns
        return Exit.OK

    def _refused(self) -> bool:
        """Return whether the new certificate cannot be used, and log why."""
        why = self._listener.refused()
        if why:
            text = f"goes on with its old certificate, because it cannot use the new one: {why}"
            self._log.event(Event(self._listener.events["open"], text, "warning"))
        return bool(why)

    def _leave(self, *_: object) -> None:
        self._leaving = True

    def _wait(self) -> bool:
        """Send signs of life, wait for `PERIOD_S`, and return whether the process must end."""
        self._manager.alive()
        parent = self._parent
        if parent is None:
            select.select([], [], [], PERIOD_S)
            return self._leaving
        parent.beat()
        readable, _, _ = select.select([parent.fd], [], [], PERIOD_S)
        return self._leaving or (bool(readable) and parent.gone())

    def _open(self) -> SessionHealth:
        listener = self._listener
        session = self._session = listener.open()
        opened_ns = clock.mono_ns()
        self._observed = Observation(opened_ns)
        health = SessionHealth(listener.most, opened_ns, listener.events)
        threading.Thread(target=self._observe, args=(session, health), daemon=True).start()
        self._log.info(listener.events["open"], text=f"listens at {listener.where}")
        self._manager.status(f"open at {listener.where}")
        return health

    def _observe(self, session: zenoh.Session, health: SessionHealth) -> None:
        """Observe the session and report its state, in every period of the process."""
        try:
            pause = threading.Event()
            while True:
                observed = self._observed = self._listener.observe(session)
                event = health.full_event(observed)
                if event is not None:
                    self._log.event(event)
                self._listener.report(session, observed, health)
                pause.wait(PERIOD_S)
        except BaseException as error:  # noqa: BLE001 - raised by `run`, which ends the process
            self._error = error


def _confine() -> None:
    """Limit the memory and lower the priority of this process, as far as the system permits it."""
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with contextlib.suppress(OSError):
        os.nice(NICE)
    # A lack of memory may end the process, and a backtrace would only fill the log.
    os.environ["RUST_BACKTRACE"] = "0"
