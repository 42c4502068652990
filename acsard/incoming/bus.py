"""The bus as the control loop sees it. `bus/bus.py` implements it with Zenoh."""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from typing import Protocol

from msgspec import Struct

from acsard.incoming.commands import Arrival
from acsard.incoming.queries import Query, Reply
from acsard.messages.schema import Message
from acsard.values import RoutersStatus


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
