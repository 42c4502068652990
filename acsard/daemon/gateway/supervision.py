"""Supervises a Zenoh session that is open to strangers, in a process that may be lost.

A stranger can make Zenoh compare key expressions for ever, keep all connections, or take memory;
all of that happens in this process. No call to Zenoh is then sure to return. Therefore one thread
looks at the session, and the main thread judges whether it still does so.
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

from acsard.daemon.gateway.watch import Events, Look, Watch
from acsard.host import clock
from acsard.host.child import Parent, end_with_parent
from acsard.host.errors import Exit
from acsard.host.logs import Log
from acsard.host.systemd import Systemd

LOOK_S = 0.25

MEMORY_BYTES = 192 << 20
"""Memory limit. The process takes 35 MB, and 72 MB with all connections in use. An attack takes
600 MB a second, faster than any look could react: the kernel refuses the memory, and that ends
the process.
"""

NICE = 5
"""Niceness: the process yields to the daemon and to programs that people run."""


class Side(Protocol):
    """Interface of the supervised session: a gateway or a router."""

    where: str
    """Addresses at which it listens, in words."""
    most: int
    """Largest number of connections from outside."""
    events: Events
    """Names of its log events."""

    def ready(self) -> bool:
        """Return whether clients may be admitted now."""

    def open(self) -> zenoh.Session:
        """Open the session and listen; blocks."""

    def look(self, session: zenoh.Session) -> Look:
        """Return the connections; the call may never return."""

    def tell(self, session: zenoh.Session, look: Look, watch: Watch) -> None:
        """Report the look to the daemon, if there is one; the call may never return."""


class Watched:
    """One life of the process."""

    def __init__(self, side: Side, log: Log, manager: Systemd, holder: int | None) -> None:
        """Run until `holder` ends, if it is a file descriptor.

        If it is a socket, the process writes a sign of life to it at each look.
        """
        self._side, self._log, self._manager = side, log, manager
        self._parent = None if holder is None else Parent(holder)
        self._session: zenoh.Session | None = None
        """Kept open until the process ends, because closing it could take for ever."""
        self._look = Look(0)
        self._error: BaseException | None = None
        self._leaving = False

    def run(self) -> Exit:
        """Run until the process must end.

        Returns OK after a signal or the holder's end, and FAILURE if the process must restart.
        """
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, self._leave)
        if self._parent is not None:
            end_with_parent(signal.SIGKILL)
        _confine()
        self._manager.ready()
        while not self._side.ready():
            self._manager.status("waits for the daemon")
            if self._wait():
                return Exit.OK
        watch = self._open()
        before_ns = clock.mono_ns()
        while not self._wait():
            if self._error is not None:
                raise self._error
            now_ns = clock.mono_ns()
            why = watch.reopen(self._look, now_ns - before_ns)
            if why is not None:
                self._log.event(why)
                return Exit.FAILURE
            before_ns = now_ns
        return Exit.OK

    def _leave(self, *_: object) -> None:
        self._leaving = True

    def _wait(self) -> bool:
        """Wait for `LOOK_S`, and return whether the process must end."""
        self._manager.alive()
        parent = self._parent
        if parent is None:
            select.select([], [], [], LOOK_S)
            return self._leaving
        parent.beat()
        readable, _, _ = select.select([parent.fd], [], [], LOOK_S)
        return self._leaving or (bool(readable) and parent.gone())

    def _open(self) -> Watch:
        side = self._side
        session = self._session = side.open()
        opened_ns = clock.mono_ns()
        self._look, watch = Look(opened_ns), Watch(side.most, opened_ns, side.events)
        threading.Thread(target=self._report, args=(session, watch), daemon=True).start()
        self._log.info(side.events["open"], text=f"listens at {side.where}")
        self._manager.status(f"open at {side.where}")
        return watch

    def _report(self, session: zenoh.Session, watch: Watch) -> None:
        """Look at the session and report, again and again."""
        try:
            pause = threading.Event()
            while True:
                look = self._look = self._side.look(session)
                event = watch.tell(look)
                if event is not None:
                    self._log.event(event)
                self._side.tell(session, look, watch)
                pause.wait(LOOK_S)
        except BaseException as error:  # noqa: BLE001 - raised by `run`, which ends the process
            self._error = error


def _confine() -> None:
    """Limit memory and priority of this process, as far as permitted."""
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with contextlib.suppress(OSError):
        os.nice(NICE)
    # The process may end for lack of memory, and a backtrace would only fill the log.
    os.environ["RUST_BACKTRACE"] = "0"
