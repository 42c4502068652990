"""How much of one kind is too much: messages a second, tries of a token, connections; pure."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Hashable

from acsard.values import NS_PER_S

MESSAGES_HZ, MESSAGES_AT_ONCE = 200.0, 400.0
"""Of one connection. At once: what lay on the way while a network was away."""

OVERRUNS = 600
"""So many messages too many end a connection."""

REQUESTS_HZ, REQUESTS_AT_ONCE = 50.0, 200.0
"""Of one token, by HTTP; a page asks now and then. Its files are for everybody."""

CONNECTIONS, CONNECTIONS_OF_ONE, CONNECTIONS_OF_TOKEN, CONNECTIONS_ALIKE = 100, 20, 30, 6
"""WebSockets of who comes from elsewhere: in all, of one address, with one token from wherever,
and with one token from one address. So a program that opens one after the other shuts out nobody
who comes from its address with another token."""

CONNECTIONS_HERE = 20
"""Of who is at the machine, and of nobody else: no stranger shuts out the robot's own browser."""

STREAMS, STREAMS_OF_ONE = 200, 50
"""Keys of other robots that are followed: in all, and for one token. Those of the page's own robot
are few, and for everybody."""

TRIES_OF_ONE, TRIES = 10, 100
"""Wrong tokens a minute: of one address, and in all."""

MINUTE_NS = 60 * NS_PER_S


class Bucket:
    """So many a second, and some at once."""

    def __init__(self, rate_hz: float, most: float, now_ns: int) -> None:
        self._rate, self._most = rate_hz / NS_PER_S, most
        self._left, self._at_ns = most, now_ns

    def take(self, now_ns: int) -> bool:
        """One more: is there room?"""
        self._left = min(self._most, self._left + (now_ns - self._at_ns) * self._rate)
        self._at_ns = now_ns
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


class Paces:
    """A bucket for each token."""

    def __init__(self) -> None:
        self._buckets: dict[str, Bucket] = {}

    def take(self, token: str, now_ns: int) -> bool:
        """One more request: is there room?"""
        bucket = self._buckets.get(token)
        if bucket is None:
            bucket = self._buckets[token] = Bucket(REQUESTS_HZ, REQUESTS_AT_ONCE, now_ns)
        return bucket.take(now_ns)


class Tries:
    """Wrong tokens of the last minute, by address."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self._count: Counter[str] = Counter()

    def spent(self, address: str, now_ns: int) -> bool:
        """This one has to wait, or all have."""
        if self._since_ns is None or now_ns - self._since_ns > MINUTE_NS:
            self._since_ns = now_ns
            self._count.clear()
        return self._count[address] >= TRIES_OF_ONE or self._count.total() >= TRIES

    def failed(self, address: str, now_ns: int) -> None:
        """One more."""
        self.spent(address, now_ns)
        self._count[address] += 1


class Places:
    """Room for so many, and for so many of one address (or token)."""

    def __init__(self, most: int, of_one: int) -> None:
        self._most, self._of_one = most, of_one
        self._taken: Counter[str] = Counter()

    @property
    def taken(self) -> int:
        """By all."""
        return self._taken.total()

    def room(self, address: str) -> bool:
        """Is there a place?"""
        return self._taken[address] < self._of_one and self.taken < self._most

    def enter(self, address: str) -> bool:
        """Take a place, if there is one."""
        if not self.room(address):
            return False
        self._taken[address] += 1
        return True

    def leave(self, address: str) -> None:
        """Give it back."""
        self._taken[address] -= 1
        if not self._taken[address]:
            del self._taken[address]


class Seats:
    """Room for the pages that are open: at the machine (without a token), and from elsewhere."""

    def __init__(self) -> None:
        self._here = Places(CONNECTIONS_HERE, CONNECTIONS_HERE)
        self._alike = Places(CONNECTIONS, CONNECTIONS_ALIKE)
        self._tokens = Places(CONNECTIONS, CONNECTIONS_OF_TOKEN)
        self._addresses = Places(CONNECTIONS, CONNECTIONS_OF_ONE)

    def missing(self, address: str, token: str) -> str:
        """Why there is no room for one more, and what to do; "" where there is."""
        for places, name, full in self._places(address, token):
            if not places.room(name):
                return full
        return ""

    def enter(self, address: str, token: str) -> str:
        """Take a place; why there is none, or ""."""
        if full := self.missing(address, token):
            return full
        for places, name, _ in self._places(address, token):
            places.enter(name)
        return ""

    def leave(self, address: str, token: str) -> None:
        """Give it back."""
        for places, name, _ in self._places(address, token):
            places.leave(name)

    def _places(self, address: str, token: str) -> list[tuple[Places, str, str]]:
        """Which a page takes one of each, under which name, and what is said when they are full."""
        if not token:
            here = f"{CONNECTIONS_HERE} pages are open at the machine itself: close some"
            return [(self._here, address, here)]
        alike = (
            f"with this token {CONNECTIONS_ALIKE} pages are open at {address} already: close some, "
            "or be invited by a token of your own"
        )
        spread = f"with this token {CONNECTIONS_OF_TOKEN} pages are open already: close some"
        full = (
            f"there is room for {CONNECTIONS} pages, {CONNECTIONS_OF_ONE} of them from one "
            "address: close some"
        )
        return [
            (self._alike, f"{address} {token}", alike),
            (self._tokens, token, spread),
            (self._addresses, address, full),
        ]


class Shares:
    """Room for so many different things, and for so many that one holds; who holds the same as
    another takes no more room in all."""

    def __init__(self, most: int, of_one: int) -> None:
        self._most, self._of_one = most, of_one
        self._held: defaultdict[Hashable, Counter[str]] = defaultdict(Counter)
        """By thing: who holds it, and how often."""

    def enter(self, holder: str, thing: Hashable) -> bool:
        """Hold it (once more), if there is room."""
        holders = self._held.get(thing)
        if holders is None and len(self._held) >= self._most:
            return False
        if not (holders and holder in holders) and self._of(holder) >= self._of_one:
            return False
        self._held[thing][holder] += 1
        return True

    def leave(self, holder: str, thing: Hashable) -> None:
        """Let go of it once."""
        holders = self._held[thing]
        holders[holder] -= 1
        if not holders[holder]:
            del holders[holder]
        if not holders:
            del self._held[thing]

    def _of(self, holder: str) -> int:
        return sum(holder in holders for holders in self._held.values())
