"""The interface of the control loop to the bus. `daemon/bus/bus.py` implements it with Zenoh."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from collections.abc import Set as AbstractSet
from typing import Protocol

from msgspec import Struct

from acsard.core.incoming.commands import Arrival
from acsard.core.incoming.queries import Query, Reply
from acsard.core.messages.encodings import DecodeError, StrictDecoder
from acsard.core.messages.frames import FeedbackTopic
from acsard.core.messages.schema import Beat, GatewayState, Message
from acsard.core.values import Announcement, Estimate, Event, Ns, RoutersStatus


class BusInput(Struct, frozen=True):
    """The input from the bus since the previous call of `Bus.take`."""

    arrivals: tuple[Arrival, ...] = ()
    queries: tuple[Query, ...] = ()
    overrun: int = 0  # samples that the control loop did not fetch in time
    displaced: tuple[Arrival, ...] = ()  # the newest of them of each sender of commands
    announced: tuple[Announcement, ...] = ()


NO_INPUT = BusInput()


class BusHealth(Struct, frozen=True):
    """What has happened to the bus since the previous call of `Bus.look`."""

    dropped: int = 0  # published messages that the bus did not send in time
    stuck: bool = False  # a send has begun to block
    routers: RoutersStatus | None = None  # None: not changed


class Waker(Protocol):
    """Wakes the control loop, from any thread."""

    def command(self) -> None:
        """Report a sample that may be a command."""

    def stop(self) -> None:
        """Report a stop."""


class BusOutput(Protocol):
    """The keys that the daemon publishes."""

    @property
    def wanted_keys(self) -> AbstractSet[str]:
        """The keys, such as "odom", that are latched or have a subscriber."""

    # Gets the time from the read of a feedback line until Zenoh had its message, in any thread.
    feedback_sent: Callable[[Ns], object]

    def publish(self, key: str, message: Message) -> None:
        """Queue a message for the subscribers of `key`, which the next `flush` sends."""

    def publish_feedback(self, topic: FeedbackTopic, estimate: Estimate) -> None:
        """Send the message of a feedback line now, or queue it like `publish`.

        Call this last in a step: another thread of Zenoh then needs this thread's core.
        """

    def publish_beat(self, beat: Beat) -> None:
        """Send a beat now, or queue it like `publish`."""

    def flush(self) -> None:
        """Start to send the queued messages, without waiting. Call this at the end of a step."""


class Bus(Protocol):
    """What the control loop uses of the bus."""

    @property
    def output(self) -> BusOutput:
        """The keys that the daemon publishes."""

    def take(self, queries: int) -> BusInput:
        """Return the input since the last call, with at most `queries` queries.

        Their order is: service calls, one slow one (ROS parameters, `set`), which comes even beyond
        the limit, and others. The rest waits.
        """

    def look(self) -> BusHealth:
        """Return what has happened to the bus since the last call; call it ten times a second."""

    def reply(self, reply: Reply) -> None:
        """Send a reply to the query of `reply.ticket`."""

    def retire(self, ticket: int) -> None:
        """End a query: no more replies to it are possible."""


GATEWAY_KEY = "gateway"

_decoder = StrictDecoder(GatewayState)


class GatewayFollower:
    """Counts the starts of the TLS gateway, and how often all its connections were in use.

    The gateway checks four times a second and reports the sum since its start. One that runs when
    the daemon starts is one start, with its earlier checks.
    """

    def __init__(self) -> None:
        self._last = GatewayState(0, 0, 0)

    def receive(self, arrival: Arrival, counters: MutableMapping[str, int]) -> int | None:
        """Decode a report, update its two counters, and return when the first certificate expires.

        Return None if this is unknown. An invalid report is ignored.
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
    "the robots (page howto/fleet of the manual)"
)


class RouterFollower:
    """Reports in the log when the connection to an endpoint in `bus.connect` is made or lost."""

    def __init__(self) -> None:
        self.status = RoutersStatus()

    def receive(
        self, status: RoutersStatus, counters: MutableMapping[str, int], events: list[Event]
    ) -> None:
        """Compare the status with the previous one; count losses, and append events.

        They are for lost connections, new ones, and those to endpoints that are not routers.
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


TRIED_AGAIN = (
    "the daemon tries again until it connects. Meanwhile, in mode `client` the robot ramps to zero "
    "and waits, and in mode `peer` programs on the robot can drive it"
)
