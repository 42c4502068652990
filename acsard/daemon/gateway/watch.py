"""Pure: decides when a gateway or a router logs an incident, and when it must restart."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Literal

from msgspec import Struct

from acsard.core.values import NS_PER_S, Event, EventName
from acsard.host.rate_limits import Bucket, Rate
from acsard.host.silence import Silence

STUCK_NS = NS_PER_S
"""Time without a new look after which Zenoh counts as stuck, ns. A look takes a millisecond."""

FIRST_NS, ALONE_NS = 5 * NS_PER_S, NS_PER_S
"""Time to wait for the daemon, ns: at the start, while other clients connect too, and later."""

REPORTS = Rate(1 / 60)
"""Rate of the reports that all connections are taken: one a minute."""

UNANSWERED = 4
"""Number of consecutive queries without an end, each at least a second old, that show a dead
connection. Data from the network then does not reach the daemon, although the connection is
open.
"""

NAMES = 5
"""Number of clients named in a report, those with the most connections."""

What = Literal["open", "full", "stuck", "alone"]

Events = dict[What, EventName]
"""Name of the log event for each incident."""

GATEWAY_EVENTS: Events = {
    "open": "gateway_open",
    "full": "gateway_full",
    "stuck": "gateway_stuck",
    "alone": "gateway_lost_daemon",
}


class Look(Struct, frozen=True):
    """State of the Zenoh session at the last look."""

    at_ns: int
    holders: tuple[str, ...] = ()
    """Common name in the certificate of each connection from outside; "" if Zenoh reports none."""
    linked: bool = False
    """True if the daemon is connected."""
    unanswered: int = 0
    """Number of consecutive queries to the daemon that have not ended."""


class Watch:
    """Judgement of one look after the other."""

    def __init__(self, most: int, opened_ns: int, events: Events = GATEWAY_EVENTS) -> None:
        """Start at the monotonic time `opened_ns`, with at most `most` connections from outside."""
        self._most, self._events = most, events
        self._linked_ns, self._patience_ns = opened_ns, FIRST_NS
        self._last_ns, self._silence = 0, Silence(STUCK_NS)
        self._reports = Bucket(REPORTS)
        self.full = 0
        """Number of looks at which all connections were in use."""

    def tell(self, look: Look) -> Event | None:
        """Return an event about a new look, or None."""
        if len(look.holders) < self._most:
            return None
        self.full += 1
        if not self._reports.take(look.at_ns):
            return None
        text = f"all {self._most} connections are taken, {crowd(look.holders)}"
        return Event(self._events["full"], f"{text}: no other client is admitted", "warning")

    def reopen(self, look: Look, passed_ns: int) -> Event | None:
        """Return why the session must be opened again, `passed_ns` after the last call, or None."""
        new, self._last_ns = look.at_ns != self._last_ns, look.at_ns
        stuck = self._silence.too_long(new, passed_ns)
        if look.linked:
            self._linked_ns, self._patience_ns = look.at_ns, ALONE_NS
        if stuck:
            text = "stuck: a client takes all its time; all clients are disconnected"
            return Event(self._events["stuck"], text, "error")
        if look.at_ns - self._linked_ns > self._patience_ns:
            text = "nothing is received from the daemon any more"
            return Event(self._events["alone"], text, "warning")
        if look.unanswered >= UNANSWERED:
            text = f"the daemon is connected, but has left {look.unanswered} queries unanswered"
            return Event(self._events["alone"], text, "warning")
        return None


def crowd(holders: Sequence[str]) -> str:
    """Describe how many connections each client has."""
    most = Counter(holders).most_common(NAMES)
    return ", ".join(f"{count} by {name or 'an unnamed one'}" for name, count in most)
