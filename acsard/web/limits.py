"""Limits per client: rates by token buckets, and counts of places. This module is pure.

The rates are those of messages, requests and wrong tokens. The places are those of connections and
subscriptions.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Hashable
from typing import NamedTuple

from acsard.core.values import NS_PER_S

OVERRUNS = 600
"""Number of messages beyond the rate limit that ends a connection."""

CONNECTIONS, CONNECTIONS_OF_ONE, CONNECTIONS_OF_TOKEN, CONNECTIONS_ALIKE = 100, 20, 30, 6
"""Limits on WebSockets from other machines: in all, per address, per token, and per token and
address.

The last limit keeps a program that opens one connection after another from locking out clients at
the same address that use another token.
"""

CONNECTIONS_HERE = 20
"""Limit on WebSockets from the robot itself. It is separate, so clients from the network cannot
lock out the robot's own browser."""

STREAMS, STREAMS_OF_ONE = 200, 50
"""Limits on subscribed keys of other robots: in all, and per token. Keys of the page's own robot
are few and are not limited."""


class Rate(NamedTuple):
    """A sustained rate with a burst allowance."""

    hz: float
    most: float
    """Number of units that may be taken at once after a rest."""


REQUESTS = Rate(50.0, 200.0)
"""Limit on HTTP requests per token. The page's static files are exempt."""

MESSAGES = Rate(200.0, 400.0)
"""Limit on messages per WebSocket. The burst allowance covers the messages a client sends when its
network returns."""

GUESSES_OF_ONE, GUESSES = Rate(10 / 60, 10.0), Rate(100 / 60, 100.0)
"""Limits on wrong tokens: from one address, and in all."""


class Bucket:
    """A token bucket."""

    def __init__(self, rate: Rate, now_ns: int) -> None:
        self._per_ns, self._most = rate.hz / NS_PER_S, rate.most
        self._left, self._at_ns = rate.most, now_ns

    def room(self, now_ns: int) -> bool:
        """Return whether a unit is left."""
        return self._filled(now_ns) >= 1.0

    def full(self, now_ns: int) -> bool:
        """Return whether all units are back."""
        return self._filled(now_ns) >= self._most

    def take(self, now_ns: int) -> bool:
        """Consume one unit; return False if the bucket is empty."""
        if not self.room(now_ns):
            return False
        self._left -= 1.0
        return True

    def _filled(self, now_ns: int) -> float:
        self._left = min(self._most, self._left + (now_ns - self._at_ns) * self._per_ns)
        self._at_ns = now_ns
        return self._left


class Buckets:
    """A token bucket for each name (an address or a token), and one for all names together."""

    def __init__(self, of_one: Rate, in_all: Rate | None = None) -> None:
        """Set the rate of each name; `in_all` is None if their sum is not limited."""
        self._of_one, self._in_all = of_one, in_all
        self._buckets: dict[str, Bucket] = {}
        self._shared: Bucket | None = None

    def take(self, name: str, now_ns: int) -> bool:
        """Consume one unit of this name; return False if it, or all together, have none left."""
        if name not in self._buckets:
            # A full bucket equals a new one. Without it, names cannot fill the memory.
            self._buckets = {k: one for k, one in self._buckets.items() if not one.full(now_ns)}
        own = self._buckets.setdefault(name, Bucket(self._of_one, now_ns))
        if self._in_all is None:
            return own.take(now_ns)
        if self._shared is None:
            self._shared = Bucket(self._in_all, now_ns)
        # A name without units of its own must not consume those of the others.
        return own.room(now_ns) and self._shared.take(now_ns) and own.take(now_ns)


class Places:
    """Places for connections, limited in all and per name (an address or a token)."""

    def __init__(self, most: int, of_one: int) -> None:
        self._most, self._of_one = most, of_one
        self._taken: Counter[str] = Counter()

    @property
    def taken(self) -> int:
        """Number of taken places."""
        return self._taken.total()

    def room(self, address: str) -> bool:
        """Return whether a place is free for this name."""
        return self._taken[address] < self._of_one and self.taken < self._most

    def enter(self, address: str) -> bool:
        """Take a place; return False if none is free."""
        if not self.room(address):
            return False
        self._taken[address] += 1
        return True

    def leave(self, address: str) -> None:
        """Give one place back."""
        self._taken[address] -= 1
        if not self._taken[address]:
            del self._taken[address]


class Seats:
    """Limits on WebSocket connections. Local ones (without a token) have a limit of their own."""

    def __init__(self) -> None:
        self._here = Places(CONNECTIONS_HERE, CONNECTIONS_HERE)
        self._alike = Places(CONNECTIONS, CONNECTIONS_ALIKE)
        self._tokens = Places(CONNECTIONS, CONNECTIONS_OF_TOKEN)
        self._addresses = Places(CONNECTIONS, CONNECTIONS_OF_ONE)

    def missing(self, address: str, token: str) -> str:
        """Return why a connection is refused and what to do, or "" if there is room."""
        for places, name, full in self._places(address, token):
            if not places.room(name):
                return full
        return ""

    def enter(self, address: str, token: str) -> str:
        """Take a place; return "" or the reason for a refusal."""
        if full := self.missing(address, token):
            return full
        for places, name, _ in self._places(address, token):
            places.enter(name)
        return ""

    def leave(self, address: str, token: str) -> None:
        """Give the place back."""
        for places, name, _ in self._places(address, token):
            places.leave(name)

    def _places(self, address: str, token: str) -> list[tuple[Places, str, str]]:
        """Return each limit for a connection, the name it counts under, and the refusal text."""
        if not token:
            here = f"{CONNECTIONS_HERE} pages are open on the robot itself: close some"
            return [(self._here, address, here)]
        alike = (
            f"with this token {CONNECTIONS_ALIKE} pages are open at {address} already: close "
            "some, or ask for a token of your own"
        )
        spread = f"with this token {CONNECTIONS_OF_TOKEN} pages are open already: close some"
        full = (
            f"only {CONNECTIONS} pages can be open, {CONNECTIONS_OF_ONE} of them from one "
            "address: close some"
        )
        return [
            (self._alike, f"{address} {token}", alike),
            (self._tokens, token, spread),
            (self._addresses, address, full),
        ]


class Shares:
    """Shared resources with a limit in all and a limit per holder.

    A resource that several holders share counts once against the limit in all.
    """

    def __init__(self, most: int, of_one: int) -> None:
        self._most, self._of_one = most, of_one
        self._held: defaultdict[Hashable, Counter[str]] = defaultdict(Counter)
        """Per resource, the number of times that each holder entered it."""

    def enter(self, holder: str, thing: Hashable) -> bool:
        """Acquire a resource, again if it is held already; return False if the limits forbid it."""
        holders = self._held.get(thing)
        if holders is None and len(self._held) >= self._most:
            return False
        if not (holders and holder in holders) and self._of(holder) >= self._of_one:
            return False
        self._held[thing][holder] += 1
        return True

    def leave(self, holder: str, thing: Hashable) -> None:
        """Release a resource once."""
        holders = self._held[thing]
        holders[holder] -= 1
        if not holders[holder]:
            del holders[holder]
        if not holders:
            del self._held[thing]

    def _of(self, holder: str) -> int:
        return sum(holder in holders for holders in self._held.values())
