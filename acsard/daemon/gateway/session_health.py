"""Derives the health of the TLS gateway's Zenoh session from consecutive observations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from msgspec import Struct

from acsard.core.throttle import Rate, Throttle
from acsard.core.values import NS_PER_S, Event, Ns
from acsard.host.child import Silence

STUCK_AFTER_NS = NS_PER_S  # an observation takes a millisecond

# Longer than `LOST_DAEMON_NS`: all clients connect at once after a restart.
FIRST_CONNECTION_NS = 5 * NS_PER_S

LOST_DAEMON_NS = NS_PER_S  # without the daemon, until a restart

REPORT_RATE = Rate(1 / 60)  # of the event that all connections are in use

MAX_UNANSWERED = 4  # in a row, 1 s each: the connection to the daemon is open, but carries no data

MAX_NAMED = 5  # clients with the most connections, in that event


class Observation(Struct, frozen=True):
    at_ns: Ns
    holders: tuple[str, ...] = ()  # common name of each connection's certificate, "" if unknown
    linked: bool = False  # the daemon is connected
    unanswered: int = 0  # queries to the daemon in a row


class SessionHealth:
    """The health of a Zenoh session, derived from consecutive observations of the session."""

    def __init__(self, most: int, opened_ns: Ns) -> None:
        # `most` connections.
        self._most = most
        self._linked_ns, self._patience_ns = opened_ns, FIRST_CONNECTION_NS
        self._last_ns, self._silence = 0, Silence(STUCK_AFTER_NS)
        self._reports = Throttle()
        self.full = 0  # observations with all connections in use

    def full_event(self, observed: Observation) -> Event | None:
        """Return an event, at most one in a minute, if all connections are in use; count it."""
        if len(observed.holders) < self._most:
            return None
        self.full += 1
        if not self._reports.take(observed.at_ns, REPORT_RATE):
            return None
        text = (
            f"all {self._most} connections are in use, {connection_counts(observed.holders)}: no "
            "other client can connect; close client programs that are not needed"
        )
        return Event("gateway_full", text, "warning")

    def restart_event(self, observed: Observation, passed_ns: Ns) -> Event | None:
        """Return an event if the process must restart, `passed_ns` after the last call.

        The same observation for too long shows that Zenoh does not respond.
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
    """Return the clients with the most connections as text; "" in `holders` is unknown."""
    most = Counter(holders).most_common(MAX_NAMED)
    return ", ".join(f"{count} by {name or 'an unnamed client'}" for name, count in most)
