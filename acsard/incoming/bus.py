"""The bus as the control loop sees it; `bus/bus.py` is the real one."""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from typing import Protocol

from msgspec import Struct

from acsard.incoming.commands import Arrival
from acsard.incoming.queries import Query, Reply
from acsard.messages.schema import Message
from acsard.values import RoutersStatus


class BusInput(Struct, frozen=True):
    """What came over the bus since the last call."""

    arrivals: tuple[Arrival, ...] = ()
    queries: tuple[Query, ...] = ()
    overrun: int = 0
    """Samples dropped because they came faster than they could be taken."""
    dropped: int = 0
    """Messages of ours dropped because the bus did not take them in time."""
    stuck: bool = False
    """The bus has just been found not to take them at all."""
    routers: RoutersStatus | None = None
    """What is connected of `bus.connect`, if that has changed."""


NOTHING = BusInput()
"""What nearly every step hears."""


class Waker(Protocol):
    """Whom the bus tells, from whatever thread, that something came in."""

    def command(self) -> None:
        """What may be a command."""

    def stop(self) -> None:
        """A stop."""


class Bus(Protocol):
    """The bus as the loop sees it."""

    @property
    def wanted(self) -> AbstractSet[str]:
        """Published keys that somebody listens to."""

    def take(self, queries: int) -> BusInput:
        """What came in since the last call, at most so many queries."""

    def publish(self, key: str, message: Message) -> None:
        """Leave a message for its listeners, until `flush`."""

    def flush(self) -> None:
        """Have what was published sent; never waits for it."""

    def reply(self, reply: Reply) -> None:
        """Answer a query by its ticket."""

    def retire(self, ticket: int) -> None:
        """No more replies by this ticket."""
