"""Pure: what the door sees of itself -> what to tell of it, and when it has to be opened anew."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Literal

from msgspec import Struct

from acsard.host.silence import Silence
from acsard.values import NS_PER_S, Event, EventName

STUCK_NS = NS_PER_S
"""A look at Zenoh takes a millisecond; longer than this, and somebody has taken its time."""

FIRST_NS, ALONE_NS = 5 * NS_PER_S, NS_PER_S
"""How long to wait for the daemon: for the first time, while others come in too, and later on."""

TOLD_EVERY_NS = 60 * NS_PER_S

UNANSWERED = 4
"""Questions in a row without an end, each a second old at least: what comes in at the door does not
arrive, though the connection stands."""

NAMES = 5
"""Holders of connections that are named, those with most of them."""

What = Literal["open", "crowded", "stuck", "alone"]

Events = dict[What, EventName]
"""What happens to it, as the log calls that."""

DOOR_EVENTS: Events = {
    "open": "door_open",
    "crowded": "door_crowded",
    "stuck": "door_stuck",
    "alone": "door_alone",
}


class Look(Struct, frozen=True):
    """What Zenoh said when it was last looked at."""

    at_ns: int
    holders: tuple[str, ...] = ()
    """The name in the certificate of each connection from outside, "" where Zenoh has none."""
    linked: bool = False
    """The daemon is connected."""
    unanswered: int = 0
    """Questions in a row that the daemon has left without an end."""


class Watch:
    """Judges look after look."""

    def __init__(self, most: int, opened_ns: int, events: Events = DOOR_EVENTS) -> None:
        """`most` connections from outside are all there are."""
        self._most, self._events = most, events
        self._linked_ns, self._patience_ns = opened_ns, FIRST_NS
        self._last_ns, self._silence = 0, Silence(STUCK_NS)
        self._told_ns: int | None = None
        self.crowded = 0
        """Looks at which all connections were taken."""

    def tell(self, look: Look) -> Event | None:
        """What there is to say of a new look."""
        if len(look.holders) < self._most:
            return None
        self.crowded += 1
        if self._told_ns is not None and look.at_ns - self._told_ns < TOLD_EVERY_NS:
            return None
        self._told_ns = look.at_ns
        text = f"all {self._most} connections are taken, {crowd(look.holders)}"
        return Event(self._events["crowded"], f"{text}: nobody else is let in", "warning")

    def reopen(self, look: Look, passed_ns: int) -> Event | None:
        """Why the door has to be opened anew, `passed_ns` after the last call; None: it has not."""
        new, self._last_ns = look.at_ns != self._last_ns, look.at_ns
        stuck = self._silence.too_long(new, passed_ns)
        if look.linked:
            self._linked_ns, self._patience_ns = look.at_ns, ALONE_NS
        if stuck:
            text = "stuck: somebody connected takes all its time; all are sent away"
            return Event(self._events["stuck"], text, "error")
        if look.at_ns - self._linked_ns > self._patience_ns:
            text = "nothing is heard of the daemon any more"
            return Event(self._events["alone"], text, "warning")
        if look.unanswered >= UNANSWERED:
            text = f"the daemon, though connected, has left {look.unanswered} questions unanswered"
            return Event(self._events["alone"], text, "warning")
        return None


def crowd(holders: Sequence[str]) -> str:
    """Who has how many connections, in words."""
    most = Counter(holders).most_common(NAMES)
    return ", ".join(f"{count} by {name or 'an unnamed one'}" for name, count in most)
