"""How much of one kind is too much: messages a second, tries of a token, connections; pure."""

from __future__ import annotations

from collections import Counter

from acsard.values import NS_PER_S

MESSAGES_HZ, MESSAGES_AT_ONCE = 200.0, 400.0
"""Of one connection. At once: what lay on the way while a network was away."""

OVERRUNS = 600
"""So many messages too many end a connection."""

CONNECTIONS, CONNECTIONS_OF_ONE = 100, 20
"""WebSockets: in all, and of one address."""

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
    """Room for so many, and for so many of one address."""

    def __init__(self, most: int, of_one: int) -> None:
        self._most, self._of_one = most, of_one
        self._taken: Counter[str] = Counter()

    @property
    def taken(self) -> int:
        """By all."""
        return self._taken.total()

    def enter(self, address: str) -> bool:
        """Take a place, if there is one."""
        if self._taken[address] >= self._of_one or self.taken >= self._most:
            return False
        self._taken[address] += 1
        return True

    def leave(self, address: str) -> None:
        """Give it back."""
        self._taken[address] -= 1
        if not self._taken[address]:
            del self._taken[address]
