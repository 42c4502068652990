"""Judges the Zenoh session of a TLS gateway or a router: what to log, and when to restart.

This module is pure. `listener_process.py` observes the session and obeys.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Literal

from msgspec import Struct

from acsard.core.values import NS_PER_S, Event, EventName
from acsard.host.child import Silence
from acsard.host.rate_limits import Bucket, Rate

STUCK_NS = NS_PER_S
"""Time without a new observation after which Zenoh counts as stuck, ns.

An observation takes a millisecond.
"""

FIRST_NS = 5 * NS_PER_S
"""Longest time after the start until the daemon connects, ns. Other clients connect then too."""

ALONE_NS = NS_PER_S
"""Longest later time without a connection of the daemon, ns."""

REPORTS = Rate(1 / 60)
"""Rate of the events that all connections are taken: one a minute."""

MAX_UNANSWERED = 4
"""Number of consecutive unanswered queries that show a dead connection. Each is a second old.

The connection to the daemon is then still open, but data does not reach the daemon.
"""

NAMES = 5
"""Largest number of clients that an event names: those with the most connections."""

Incident = Literal["open", "full", "stuck", "alone"]

Events = dict[Incident, EventName]
"""Name of the log event for each incident."""

GATEWAY_EVENTS: Events = {
    "open": "gateway_open",
    "full": "gateway_full",
    "stuck": "gateway_stuck",
    "alone": "gateway_lost_daemon",
}


class Observation(Struct, frozen=True):
    """State of the Zenoh session at a time."""

    at_ns: int
    """Monotonic time, ns."""
    holders: tuple[str, ...] = ()
    """Common name in the certificate of each connection from the network.

    It is "" if Zenoh does not report the name.
    """
    linked: bool = False
    """True if the daemon is connected. A router, which needs no daemon, always has True."""
    unanswered: int = 0
    """Number of consecutive queries to the daemon that have not ended."""


class SessionHealth:
    """Judges one observation of the session after the other."""

    def __init__(self, most: int, opened_ns: int, events: Events = GATEWAY_EVENTS) -> None:
        """Begin at the monotonic time `opened_ns`, at which the session was opened.

        `most` is the largest number of connections from the network. `events` names the log events.
        """
        self._most, self._events = most, events
        self._linked_ns, self._patience_ns = opened_ns, FIRST_NS
        self._last_ns, self._silence = 0, Silence(STUCK_NS)
        self._reports = Bucket(REPORTS)
        self.full = 0
        """Number of observations in which all connections were taken."""

    def full_event(self, observed: Observation) -> Event | None:
        """Return an event if all connections are taken and the last event is a minute old."""
        if len(observed.holders) < self._most:
            return None
        self.full += 1
        if not self._reports.take(observed.at_ns):
            return None
        text = (
            f"all {self._most} connections are taken, {connection_counts(observed.holders)}: no "
            "other client is admitted; close programs that are not needed"
        )
        return Event(self._events["full"], text, "warning")

    def restart_event(self, observed: Observation, passed_ns: int) -> Event | None:
        """Return an event that says why the process must restart, or None if it need not.

        `observed` is the newest observation, perhaps the same as in the last call. `passed_ns` is
        the time since the last call.
        """
        new, self._last_ns = observed.at_ns != self._last_ns, observed.at_ns
        stuck = self._silence.too_long(new, passed_ns)
        if observed.linked:
            self._linked_ns, self._patience_ns = observed.at_ns, ALONE_NS
        if stuck:
            text = "Zenoh hangs, because a client takes all its time; all clients are disconnected"
            return Event(self._events["stuck"], text, "error")
        if observed.at_ns - self._linked_ns > self._patience_ns:
            text = "the daemon is not connected any more; all clients are disconnected"
            return Event(self._events["alone"], text, "warning")
        if observed.unanswered >= MAX_UNANSWERED:
            text = (
                f"the daemon is connected, but has left {observed.unanswered} queries unanswered; "
                "all clients are disconnected"
            )
            return Event(self._events["alone"], text, "warning")
        return None


def connection_counts(holders: Sequence[str]) -> str:
    """Describe how many connections each client has; `holders` has a name for each connection."""
    most = Counter(holders).most_common(NAMES)
    return ", ".join(f"{count} by {name or 'an unnamed client'}" for name, count in most)
