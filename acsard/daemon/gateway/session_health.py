"""Derives the health of the TLS gateway's Zenoh session from consecutive observations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from msgspec import Struct

from acsard.core.values import NS_PER_S, Event
from acsard.host.child import Silence
from acsard.host.rate_limits import Bucket, Rate

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


class Observation(Struct, frozen=True):
    """The state of the Zenoh session at one moment."""

    at_ns: int
    """Monotonic time of the observation, ns."""
    holders: tuple[str, ...] = ()
    """For each connection, the common name in the client's certificate, or "" if it is unknown."""
    linked: bool = False
    """True if the daemon is connected."""
    unanswered: int = 0
    """Number of consecutive queries that the daemon has not answered in time."""


class SessionHealth:
    """The health of a Zenoh session, derived from consecutive observations of the session."""

    def __init__(self, most: int, opened_ns: int) -> None:
        """Prepare for the first observation.

        Args:
            most: largest number of connections.
            opened_ns: monotonic time at which the session was opened, ns.
        """
        self._most = most
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
        return Event("gateway_full", text, "warning")

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
            return Event("gateway_stuck", text, "error")
        if observed.at_ns - self._linked_ns > self._patience_ns:
            text = (
                "the TLS gateway has no connection to the daemon; the gateway restarts, which "
                "disconnects all clients"
            )
            return Event("gateway_lost_daemon", text, "warning")
        if observed.unanswered >= MAX_UNANSWERED:
            text = (
                f"the daemon is connected to the TLS gateway, but has left {observed.unanswered} "
                "queries unanswered; the gateway restarts, which disconnects all clients"
            )
            return Event("gateway_lost_daemon", text, "warning")
        return None


def connection_counts(holders: Sequence[str]) -> str:
    """Return a text with the clients that have the most connections, and the count of each.

    `holders` contains the name of the client of each connection, or "" if the name is unknown.
    """
    most = Counter(holders).most_common(MAX_NAMED)
    return ", ".join(f"{count} by {name or 'an unnamed client'}" for name, count in most)
