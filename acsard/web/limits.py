"""The limits that the page's server sets for its clients. This module is pure.

A network is an IPv4 address, or the /64 network of an IPv6 address (`callers.network_of`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Hashable
from typing import Generic, TypeVar

from acsard.host.rate_limits import Places, Rate
from acsard.web.callers import network_of

# From other machines, and from the robot itself. A browser opens six besides its WebSocket.
MAX_TCP_CONNECTIONS, MAX_LOCAL_TCP_CONNECTIONS = 256, 96

# Without a valid token from one network, and with one valid token. Further ones with this token
# count as ones without.
MAX_TCP_OF_NETWORK, MAX_TCP_OF_TOKEN = 64, 64

# Each token keeps these connections, which one browser needs, even if all places are taken.
RESERVED_TCP_OF_TOKEN = 7

# From other machines, even if the process may open only few files.
MIN_TCP_CONNECTIONS = 16

# Files for other uses than connections. About 20 are always open.
RESERVED_FILES = 128

# Above this, a client's next request waits, and its WebSocket gets no new values. asyncio's default
# for TLS is 512 KiB.
MAX_UNREAD_BYTES = 32768

# Messages beyond `MESSAGE_RATE` after which a WebSocket is closed.
MAX_OVERRUNS = 600

# From other machines: in total, per network, and per token.
MAX_WEBSOCKETS, MAX_WEBSOCKETS_OF_NETWORK, MAX_WEBSOCKETS_OF_TOKEN = 100, 20, 30

# So one program cannot lock out other tokens in its network.
MAX_WEBSOCKETS_OF_TOKEN_IN_NETWORK = 6

# From the robot itself. Others do not count here.
MAX_LOCAL_WEBSOCKETS = 20

# HTTP requests per token; the page's static files are exempt.
REQUEST_RATE = Rate(50.0, 200.0)

# Stops, pictures and new WebSockets of each token in each network; further ones wait. A page asks
# for at most 20 pictures a second.
STOPS, PICTURES, OPENINGS = Rate(50.0, 100.0), Rate(100.0, 200.0), Rate(4.0, 20.0)

# Requests without a valid token from one network; further ones wait. A phone loads the page with
# 16, so eight phones behind one address can do so at the same time.
STRANGER_RATE = Rate(30.0, 150.0)

# TLS handshakes per network; further ones wait. A browser needs six to load the page.
HANDSHAKE_RATE = Rate(30.0, 100.0)

# Delay of a request beyond a rate. An immediate refusal costs as much as an answer.
REFUSAL_DELAY_S = 0.5

# Messages per WebSocket. A client sends a burst when its network returns.
MESSAGE_RATE = Rate(200.0, 400.0)

# Per token or local WebSocket; the stick sends 20. 24 WebSockets at 180 commands a second made the
# daemon drop half of another driver's, because it takes 1000 from this server.
COMMAND_RATE = Rate(60.0, 120.0)

# Wrong tokens from one network, and in total.
GUESSES_OF_ONE, GUESSES = Rate(10 / 60, 10.0), Rate(100 / 60, 100.0)


C = TypeVar("C", bound=Hashable)


def sockets_for(files: int) -> int:
    """Return the most TCP connections from other machines of a process with so many files."""
    # A connection needs two files while it fetches a recording.
    return max(
        MIN_TCP_CONNECTIONS,
        min(MAX_TCP_CONNECTIONS, (files - RESERVED_FILES) // 2 - MAX_LOCAL_TCP_CONNECTIONS),
    )


class Sockets(Generic[C]):
    """The open TCP connections, up to a maximum number.

    If the maximum is reached, each new connection displaces an older one. The network with the most
    connections without a valid token loses its oldest of them. If every connection has shown a
    valid token, the token with the most connections loses its oldest. However, if this token has at
    most `RESERVED_TCP_OF_TOKEN`, the new connection is refused instead. A network with
    `MAX_TCP_OF_NETWORK` connections without a valid token displaces its own oldest in any case. A
    connection beyond `MAX_TCP_OF_TOKEN` counts as one without a valid token.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        # without a valid token, by network, oldest first
        self._strangers: dict[str, dict[C, None]] = {}
        self._networks: dict[C, str] = {}
        self._known: dict[C, str] = {}  # those that count toward the limit of their token
        self._shown: dict[C, str] = {}  # the last valid token, also beyond that limit
        self._tokens: Counter[str] = Counter()

    def enter(self, network: str, newcomer: C) -> C | None:
        """Add a connection, and return the one to close, which may be `newcomer` itself."""
        own = self._strangers.get(network, {})
        victim = None
        if len(own) >= MAX_TCP_OF_NETWORK:
            victim = next(iter(own))
            self.leave(victim)
        elif len(self._networks) >= self._most and (victim := self.displaced()) is None:
            return newcomer
        self._strangers.setdefault(network, {})[newcomer] = None
        self._networks[newcomer] = network
        return victim

    def displaced(self) -> C | None:
        """Remove and return the connection that makes room, or None if all may stay."""
        if self._strangers:
            network = max(self._strangers, key=lambda name: len(self._strangers[name]))
            victim = next(iter(self._strangers[network]))
        else:
            token, count = max(self._tokens.items(), key=lambda item: item[1], default=("", 0))
            if count <= RESERVED_TCP_OF_TOKEN:
                return None
            victim = next(connection for connection, its in self._known.items() if its == token)
        self.leave(victim)
        return victim

    def prove(self, connection: C, token: str) -> None:
        """Record the valid token of a connection; "" on the robot itself.

        A later token replaces the earlier one, except that a token with `MAX_TCP_OF_TOKEN`
        connections gets no further one.
        """
        network, before = self._networks.get(connection), self._known.get(connection)
        if network is None:
            return
        self._shown[connection] = token
        if before == token or self._tokens[token] >= MAX_TCP_OF_TOKEN:
            return
        if before is None:
            self._forget(network, connection)
        else:
            self._fewer(before)
        self._known[connection] = token
        self._tokens[token] += 1

    def leave(self, connection: C) -> None:
        network = self._networks.pop(connection, None)
        self._shown.pop(connection, None)
        if network is None:
            return
        token = self._known.pop(connection, None)
        if token is None:
            self._forget(network, connection)
            return
        self._fewer(token)

    def ended(self, valid: Collection[str]) -> list[C]:
        """Return the connections whose last token is not in `valid`."""
        return [
            connection for connection, token in self._shown.items() if token and token not in valid
        ]

    def strangers(self) -> list[C]:
        """Return those without a valid token, and those beyond `MAX_TCP_OF_TOKEN`."""
        return [connection for network in self._strangers.values() for connection in network]

    def _fewer(self, token: str) -> None:
        self._tokens[token] -= 1
        if not self._tokens[token]:
            del self._tokens[token]

    def _forget(self, network: str, connection: C) -> None:
        del self._strangers[network][connection]
        if not self._strangers[network]:
            del self._strangers[network]


class WebSocketLimits:
    """Limits the open WebSockets; those of the robot itself are counted separately."""

    def __init__(self) -> None:
        self._here = Places(MAX_LOCAL_WEBSOCKETS, MAX_LOCAL_WEBSOCKETS)
        self._alike = Places(MAX_WEBSOCKETS, MAX_WEBSOCKETS_OF_TOKEN_IN_NETWORK)
        self._tokens = Places(MAX_WEBSOCKETS, MAX_WEBSOCKETS_OF_TOKEN)
        self._networks = Places(MAX_WEBSOCKETS, MAX_WEBSOCKETS_OF_NETWORK)

    def refusal(self, address: str, token: str) -> str:
        """Return "" if a client may open a WebSocket now, else the reason and the remedy."""
        for places, name, full in self._places(address, token):
            if not places.room(name):
                return full
        return ""

    def enter(self, address: str, token: str) -> str:
        """Count a new WebSocket, or return the reason and the remedy."""
        if full := self.refusal(address, token):
            return full
        for places, name, _ in self._places(address, token):
            places.enter(name)
        return ""

    def leave(self, address: str, token: str) -> None:
        for places, name, _ in self._places(address, token):
            places.leave(name)

    def _places(self, address: str, token: str) -> list[tuple[Places, str, str]]:
        if not token:
            here = f"{MAX_LOCAL_WEBSOCKETS} pages are open on the robot itself: close some"
            return [(self._here, address, here)]
        network = network_of(address)
        alike = (
            f"{MAX_WEBSOCKETS_OF_TOKEN_IN_NETWORK} pages with this token are open at {network} "
            "already: close some, or ask for a token of your own"
        )
        spread = f"{MAX_WEBSOCKETS_OF_TOKEN} pages with this token are open already: close some"
        full = (
            f"{MAX_WEBSOCKETS} pages are open in total, or {MAX_WEBSOCKETS_OF_NETWORK} from "
            f"{network}: close some of them"
        )
        return [
            (self._alike, f"{network} {token}", alike),
            (self._tokens, token, spread),
            (self._networks, network, full),
        ]
