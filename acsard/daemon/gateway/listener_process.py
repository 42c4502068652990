"""Runs a Zenoh session that is open to the network, in a separate process that can be restarted.

A malicious client can make Zenoh compare key expressions for ever, use all connections, or use much
memory. This process then suffers, but the daemon does not. During such an attack a call to Zenoh
may never return. So a separate thread observes the session, and the main thread checks that new
observations keep coming.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import signal
import threading
from collections import Counter
from collections.abc import Sequence
from typing import Literal

import zenoh
from msgspec import Struct

from acsard.bus.certificate_watch import CertificateFiles
from acsard.core.values import NS_PER_S, Event, EventName
from acsard.host import clock
from acsard.host.child import Parent, Silence, end_signals, end_with_parent
from acsard.host.errors import Exit
from acsard.host.logs import Log
from acsard.host.rate_limits import Bucket, Rate
from acsard.host.systemd import Systemd

STUCK_AFTER_NS = NS_PER_S
"""Time without a new observation after which Zenoh counts as stuck, ns. An observation takes a
millisecond."""

FIRST_CONNECTION_NS = 5 * NS_PER_S
"""Longest time from the opening of the Zenoh session to its connection with the daemon, ns. After
this time, this process restarts. The time is longer than `LOST_DAEMON_NS`, because all clients
connect at the same moment after a restart."""

LOST_DAEMON_NS = NS_PER_S
"""If the Zenoh session has lost its connection to the daemon for longer than this, ns, this process
restarts."""

REPORT_RATE = Rate(1 / 60)
"""Largest rate of the log event that reports that all connections are in use: one a minute."""

MAX_UNANSWERED = 4
"""If the daemon leaves this number of consecutive queries unanswered for 1 s each, the gateway's
connection to the daemon counts as dead. Such a connection is open, but carries no data."""

MAX_NAMED = 5
"""Largest number of clients that the event about used-up connections names: those with the most
connections."""

Incident = Literal["open", "full", "stuck", "alone"]

Events = dict[Incident, EventName]
"""Maps each incident to the name of its log event. The incidents are: the session listens (`open`),
all connections are in use (`full`), Zenoh hangs (`stuck`), the daemon is not connected
(`alone`)."""

GATEWAY_EVENTS: Events = {
    "open": "gateway_open",
    "full": "gateway_full",
    "stuck": "gateway_stuck",
    "alone": "gateway_lost_daemon",
}


class Observation(Struct, frozen=True):
    """The state of the Zenoh session at one moment."""

    at_ns: int
    """Monotonic time of the observation, ns."""
    holders: tuple[str, ...] = ()
    """For each connection, the common name in the client's certificate, or "" if it is unknown."""
    linked: bool = False
    """True if the daemon is connected. For a router, which needs no daemon, it is always True."""
    unanswered: int = 0
    """Number of consecutive queries that the daemon has not answered in time."""


class SessionHealth:
    """The health of a Zenoh session, derived from consecutive observations of the session."""

    def __init__(self, most: int, opened_ns: int, events: Events = GATEWAY_EVENTS) -> None:
        """Prepare for the first observation.

        Args:
            most: largest number of connections.
            opened_ns: monotonic time at which the session was opened, ns.
            events: names of the log events.
        """
        self._most, self._events = most, events
        self._linked_ns, self._patience_ns = opened_ns, FIRST_CONNECTION_NS
        self._last_ns, self._silence = 0, Silence(STUCK_AFTER_NS)
        self._reports = Bucket(REPORT_RATE)
        self.full = 0
        """Number of observations in which all connections were in use."""

    def full_event(self, observed: Observation) -> Event | None:
        """Return a log event if all connections are in use, else None.

        Also count the observation in `full`. At most one event is returned in each minute.
        """
        if len(observed.holders) < self._most:
            return None
        self.full += 1
        if not self._reports.take(observed.at_ns):
            return None
        text = (
            f"all {self._most} connections are in use, {connection_counts(observed.holders)}: no "
            "other client can connect; close client programs that are not needed"
        )
        return Event(self._events["full"], text, "warning")

    def restart_event(self, observed: Observation, passed_ns: int) -> Event | None:
        """Return a log event with the reason why the process must restart, or None.

        Args:
            observed: the latest observation. If it stays the same for too long, the observing
                thread is stuck, because Zenoh does not respond.
            passed_ns: time since the last call, ns.
        """
        new, self._last_ns = observed.at_ns != self._last_ns, observed.at_ns
        stuck = self._silence.too_long(new, passed_ns)
        if observed.linked:
            self._linked_ns, self._patience_ns = observed.at_ns, LOST_DAEMON_NS
        if stuck:
            text = (
                "Zenoh in this process does not respond, because a client keeps it too busy; the "
                "process restarts, which disconnects all clients"
            )
            return Event(self._events["stuck"], text, "error")
        if observed.at_ns - self._linked_ns > self._patience_ns:
            text = (
                "the TLS gateway has no connection to the daemon; the gateway restarts, which "
                "disconnects all clients"
            )
            return Event(self._events["alone"], text, "warning")
        if observed.unanswered >= MAX_UNANSWERED:
            text = (
                f"the daemon is connected to the TLS gateway, but has left {observed.unanswered} "
                "queries unanswered; the gateway restarts, which disconnects all clients"
            )
            return Event(self._events["alone"], text, "warning")
        return None


def connection_counts(holders: Sequence[str]) -> str:
    """Return a text with the clients that have the most connections, and the count of each.

    `holders` contains the name of the client of each connection, or "" if the name is unknown.
    """
    most = Counter(holders).most_common(MAX_NAMED)
    return ", ".join(f"{count} by {name or 'an unnamed client'}" for name, count in most)


CHECK_PERIOD_S = 0.25
"""Interval at which a thread observes the Zenoh session, s. At the same interval, the main thread
checks that this thread still makes observations."""

MAX_MEMORY_BYTES = 192 << 20
"""Limit of the data memory of this process, bytes. The process needs 35 MB, or 72 MB if all
connections are in use. An attack can use another 600 MB in each second, too fast for a periodic
check. So the kernel enforces the limit: it refuses more memory, which ends the process."""


class Listener:
    """A Zenoh session that is open to the network: the TLS gateway, or the router of a fleet."""

    where: str
    """Addresses at which the session listens, separated by commas."""
    most: int
    """Largest number of connections from the network."""
    events: Events
    """Names of the log events for the incidents of the session."""
    files: CertificateFiles | None
    """The certificate files of the session, or None if the session has no such files."""

    def ready(self) -> bool:
        """Return whether the session may be opened now. The TLS gateway waits for the daemon."""
        return True

    def open(self) -> zenoh.Session:
        """Open the session, so that clients can connect. This call blocks."""
        raise NotImplementedError

    def observe(self, session: zenoh.Session) -> Observation:
        """Return the present state of the session. This call may never return."""
        raise NotImplementedError

    def report(self, session: zenoh.Session, observed: Observation, health: SessionHealth) -> None:
        """Publish the state of the session for the daemon. This call may never return.

        A router has no daemon and publishes nothing.
        """


class ListenerProcess:
    """The main loop of a process that opens and observes the session of one `Listener`.

    The loop ends when the process must end or be restarted.
    """

    def __init__(self, listener: Listener, log: Log, manager: Systemd, parent: int | None) -> None:
        """Prepare the process; `run` runs it.

        Args:
            listener: the session of this process.
            log: the log of this process.
            manager: the connection to systemd.
            parent: file descriptor whose other end belongs to the parent process, or None. This
                process ends when the parent closes that end. If the descriptor is a socket, this
                process writes a sign of life to it in every period.
        """
        self._listener, self._log, self._manager = listener, log, manager
        self._parent = None if parent is None else Parent(parent)
        self._session: zenoh.Session | None = None
        """The open session. It is never closed, because closing it could take for ever."""
        self._observed = Observation(0)
        self._error: BaseException | None = None
        self._leaving = False

    def run(self) -> Exit:
        """Run until the process must end, and return its exit code.

        The code is OK after a signal or the end of the parent, and FAILURE if a restart is needed.
        If the observing thread fails, raise its exception.
        """
        for number in end_signals():
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
            if self._renewed():
                text = (
                    "this process restarts with its new certificate, which disconnects all clients"
                )
                self._log.info(self._listener.events["open"], text=text)
                return Exit.FAILURE
            before_ns = now_ns
        return Exit.OK

    def _renewed(self) -> bool:
        """Return whether the process must restart to use a new certificate."""
        files = self._listener.files
        if files is None or not files.renewed():
            return False
        why = files.refused()
        if why:
            text = (
                "this process goes on with its old certificate, because it cannot use the new one: "
                f"{why}"
            )
            self._log.event(Event(self._listener.events["open"], text, "warning"))
        return not why

    def _leave(self, *_: object) -> None:
        self._leaving = True

    def _wait(self) -> bool:
        """Wait for `CHECK_PERIOD_S`, and return whether the process must end."""
        self._manager.alive()
        parent = self._parent
        if parent is None:
            select.select([], [], [], CHECK_PERIOD_S)
            return self._leaving
        parent.beat()
        readable, _, _ = select.select([parent.fd], [], [], CHECK_PERIOD_S)
        return self._leaving or (bool(readable) and parent.is_gone())

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
        try:
            pause = threading.Event()
            while True:
                observed = self._observed = self._listener.observe(session)
                event = health.full_event(observed)
                if event is not None:
                    self._log.event(event)
                self._listener.report(session, observed, health)
                pause.wait(CHECK_PERIOD_S)
        except BaseException as error:  # noqa: BLE001 - raised by `run`, which ends the process
            self._error = error


def _confine() -> None:
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with contextlib.suppress(OSError):
        os.nice(5)  # the daemon and ordinary programs have priority over this process
    # If a lack of memory ends the process, a backtrace would only fill the log.
    os.environ["RUST_BACKTRACE"] = "0"
