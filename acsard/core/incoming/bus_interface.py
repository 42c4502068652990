"""The interface of the control loop to the bus. `daemon/bus/bus.py` implements it with Zenoh."""

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
    """The input from the bus since the previous call of `Bus.take`."""

    arrivals: tuple[Arrival, ...] = ()
    queries: tuple[Query, ...] = ()
    overrun: int = 0
    """Number of samples that were dropped because the control loop did not fetch them in time."""
    overrun_sources: tuple[str, ...] = ()
    """Names of the command sources of the samples that `overrun` counts."""
    dropped: int = 0
    """Number of published messages that were dropped because the bus did not send them in time."""
    stuck: bool = False
    """True if a send on the bus has begun to block since the previous call of `Bus.take`."""
    routers: RoutersStatus | None = None
    """State of the connections to the endpoints in `bus.connect`; None if the state has not
    changed."""


NO_INPUT = BusInput()


class Waker(Protocol):
    """Wakes the control loop. The bus may call these methods from any thread."""

    def command(self) -> None:
        """Wake the control loop because a sample has arrived that may be a command."""

    def stop(self) -> None:
        """Wake the control loop because a stop has arrived."""


class Bus(Protocol):
    """The methods of the bus that the control loop calls."""

    @property
    def wanted_keys(self) -> AbstractSet[str]:
        """The keys, such as "odom", of the topics that are latched or have a subscriber now."""

    def take(self, queries: int) -> BusInput:
        """Return the input from the bus since the last call.

        The result contains at most `queries` queries, in this order: service calls, one slow query
        (ROS parameters or a `set`), other queries. If service calls alone reach the limit, the slow
        query is returned in addition. The remaining queries wait for the next call.
        """

    def publish(self, key: str, message: Message) -> None:
        """Queue a message for the subscribers of `key`. The next call of `flush` sends it."""

    def flush(self) -> None:
        """Start to send the queued messages. Do not wait until they are sent."""

    def reply(self, reply: Reply) -> None:
        """Send a reply to the query with the number `reply.ticket`."""

    def retire(self, ticket: int) -> None:
        """End the query with the number `ticket`. No more replies to this query are possible."""


GATEWAY_KEY = "gateway"

_decoder = Decoder(GatewayState)


class GatewayFollower:
    """Counts the starts of the TLS gateway, and how often all its connections were in use.

    The gateway checks its connections four times a second, and reports in how many checks since its
    start all connections were in use. A gateway that already runs when the daemon starts counts as
    one start, and its earlier checks are counted too.
    """

    def __init__(self) -> None:
        self._last = GatewayState(0, 0, 0)

    def receive(self, arrival: Arrival, counters: MutableMapping[str, int]) -> int | None:
        """Decode a report of the TLS gateway, and update the two gateway counters in `counters`.

        `arrival` is the sample with the report. Return the time at which the first of the TLS
        certificates expires, wall-clock ns since 1970. Return None if this time is unknown, or if
        the report is invalid. An invalid report is ignored.
        """
        try:
            report = _decoder.decode(arrival.encoding, arrival.payload)
        except DecodeError:
            return None  # only local programs may put on this key, so ignoring it is harmless
        last = self._last
        if report.opened != last.opened:
            counters["gateway_opened"] += 1
            last = GatewayState(report.opened, 0, 0)
        if report.full > last.full:
            counters["gateway_full"] += report.full - last.full
        self._last = report
        return report.certificate_ends or None


PEER_ADVICE = (
    "A peer, such as a robot's daemon, does not forward messages, so a client of one robot sees "
    "only that robot, and `acsard call stop --id '*'` stops only that robot; put a router between "
    "the robots (deploy/zenoh/README.md)"
)


class RouterFollower:
    """Reports in the log when the connection to an endpoint in `bus.connect` is made or lost."""

    def __init__(self) -> None:
        self.status = RoutersStatus()

    def receive(
        self, status: RoutersStatus, counters: MutableMapping[str, int], events: list[Event]
    ) -> None:
        """Store the present status, and compare it with the previous status.

        Append up to three events to `events`: for the connections that were lost, for those that
        were made, and for the connected endpoints that are not routers. Also count the lost
        connections in `counters`.
        """
        before, self.status = self.status, status
        lost = [endpoint for endpoint in status.missing if endpoint not in before.missing]
        made = [endpoint for endpoint in status.connected if endpoint not in before.connected]
        if lost:
            counters["router_missing"] = counters.get("router_missing", 0) + len(lost)
            text = f"not connected to {', '.join(lost)}; {TRIED_AGAIN}"
            events.append(Event("router_missing", text, "warning"))
        if made:
            events.append(Event("router_found", f"connected to {', '.join(made)}"))
        peers = [endpoint for endpoint in status.peers if endpoint not in before.peers]
        if peers:
            text = f"these endpoints are peers, not routers: {', '.join(peers)}. {PEER_ADVICE}"
            events.append(Event("not_a_router", text, "warning"))


TRIED_AGAIN = "the daemon tries again until it connects, and the robot can drive meanwhile"
