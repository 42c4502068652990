"""The bus as the control loop sees it; `daemon/bus/bus.py` implements it with Zenoh.

It also follows the connections of the bus: the reports of the TLS gateway and the endpoints of
`bus.connect` become counters and events.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from collections.abc import Set as AbstractSet
from typing import Protocol

from msgspec import Struct

from acsard.core.incoming.commands import Arrival
from acsard.core.incoming.queries import Query, Reply
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.schema import GatewayState, Message
from acsard.core.values import Event, RoutersStatus


class BusInput(Struct, frozen=True):
    """Input from the bus since the last call."""

    arrivals: tuple[Arrival, ...] = ()
    queries: tuple[Query, ...] = ()
    overrun: int = 0
    """Number of samples that were dropped because they came faster than the control loop took
    them."""
    dropped: int = 0
    """Number of published messages that were dropped because the bus did not take them in time."""
    stuck: bool = False
    """True once when the bus starts to block."""
    routers: RoutersStatus | None = None
    """The connections of `bus.connect` if they have changed, else None."""


NOTHING = BusInput()
"""The input of nearly every step."""


class Waker(Protocol):
    """The receiver of wake-ups from the bus, called on any thread."""

    def command(self) -> None:
        """Report a sample that may be a command."""

    def stop(self) -> None:
        """Report a stop."""


class Bus(Protocol):
    """The methods of the bus that the control loop calls."""

    @property
    def wanted(self) -> AbstractSet[str]:
        """Published topics that have a listener."""

    def take(self, queries: int) -> BusInput:
        """Return the input since the last call, with at most `queries` + 1 queries."""

    def publish(self, key: str, message: Message) -> None:
        """Queue a message for its listeners. `flush` sends it."""

    def flush(self) -> None:
        """Send the queued messages. Never wait for it."""

    def reply(self, reply: Reply) -> None:
        """Reply to the query that holds the ticket `reply.ticket`."""

    def retire(self, ticket: int) -> None:
        """End the query of this ticket: it gets no more replies."""


GATEWAY_KEY = "gateway"

_decoder = Decoder(GatewayState)


class GatewayReports:
    """Follower of the TLS gateway's reports, also across restarts of the gateway."""

    def __init__(self) -> None:
        self._last = GatewayState(0, 0, 0)

    def take(self, arrival: Arrival, counters: MutableMapping[str, int]) -> int | None:
        """Count the news in a report.

        Return the wall time at which the certificate ends, if it is known.
        """
        try:
            told = _decoder.decode(arrival.encoding, arrival.payload)
        except DecodeError:
            return None  # only local programs may write on this key, so a bad report is ignored
        last = self._last
        if told.opened != last.opened:
            counters["gateway_opened"] += 1
            last = GatewayState(told.opened, 0, 0)
        if told.full > last.full:
            counters["gateway_full"] += told.full - last.full
        self._last = told
        return told.certificate_ends or None


PEER = (
    "is not a router but another peer, perhaps a robot's daemon. A peer does not forward "
    "messages, so a client of one robot sees only that robot, and `acsard call stop --id '*'` "
    "stops no other; put a router between the robots (deploy/zenoh/README.md)"
)


class RouterChanges:
    """Follower of the endpoints that this daemon should be connected to."""

    def __init__(self) -> None:
        self.status = RoutersStatus()

    def take(
        self, status: RoutersStatus, counters: MutableMapping[str, int], events: list[Event]
    ) -> None:
        """Take the present status. Log and count each connection that was lost or made."""
        before, self.status = self.status, status
        gone = [one for one in status.missing if one not in before.missing]
        come = [one for one in status.connected if one not in before.connected]
        if gone:
            counters["router_missing"] = counters.get("router_missing", 0) + len(gone)
            events.append(Event("router_missing", _words("not connected to", gone), "warning"))
        if come:
            events.append(Event("router_found", _words("connected to", come)))
        peers = [one for one in status.peers if one not in before.peers]
        if peers:
            events.append(Event("not_a_router", f"{', '.join(peers)} {PEER}", "warning"))


def _words(what: str, endpoints: list[str]) -> str:
    tried = (
        "; the daemon tries again until it connects, and driving goes on"
        if what.startswith("not")
        else ""
    )
    return f"{what} {', '.join(endpoints)}{tried}"
