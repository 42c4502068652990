"""The limits that the page's server sets for its clients. This module is pure.

A network is an IPv4 address, or the /64 network of an IPv6 address (`callers.network_of`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Hashable
from typing import Generic, TypeVar

from acsard.host.rate_limits import Places, Rate
from acsard.web.callers import network_of

MAX_TCP_CONNECTIONS, MAX_LOCAL_TCP_CONNECTIONS = 256, 96
"""Maximum number of TCP connections from other machines (`MAX_TCP_CONNECTIONS`), and from the robot
itself (`MAX_LOCAL_TCP_CONNECTIONS`). A browser opens six connections in addition to its
WebSocket."""

MAX_TCP_OF_NETWORK, MAX_TCP_OF_TOKEN = 64, 64
"""`MAX_TCP_OF_NETWORK` is the maximum number of TCP connections without a valid token from one
network. `MAX_TCP_OF_TOKEN` is the maximum number of TCP connections with the same valid token. Any
further connection with this token counts as a connection without a valid token."""

RESERVED_TCP_OF_TOKEN = 7
"""Number of TCP connections that each token keeps even if the limit on all connections is reached.
One browser needs this number."""

MIN_TCP_CONNECTIONS = 16
"""Number of TCP connections from other machines that the server always allows, even if the process
may open only few files."""

RESERVED_FILES = 128
"""Number of open files that are reserved for uses other than TCP connections. About 20 such
files are always open."""

MAX_UNREAD_BYTES = 32768
"""Number of bytes that the server buffers for a client that does not read them. Above this number,
the client's next request waits, and the client's WebSocket gets no new values. asyncio's default
for TLS is 512 KiB."""

MAX_OVERRUNS = 600
"""The server closes a WebSocket after this number of messages beyond the limit `MESSAGE_RATE`."""

MAX_WEBSOCKETS, MAX_WEBSOCKETS_OF_NETWORK, MAX_WEBSOCKETS_OF_TOKEN = 100, 20, 30
"""Maximum numbers of WebSockets from other machines: in total, per network, and per token."""

MAX_WEBSOCKETS_OF_TOKEN_IN_NETWORK = 6
"""Maximum number of WebSockets per token in one network. Because of this limit, one program cannot
lock out other tokens in its network."""

MAX_LOCAL_WEBSOCKETS = 20
"""Maximum number of WebSockets from the robot itself. WebSockets from other machines do not count
here."""

REQUEST_RATE = Rate(50.0, 200.0)
"""Limit on HTTP requests per token, as a rate per second and a largest burst. The page's static
files are exempt."""

STOPS, PICTURES, OPENINGS = Rate(50.0, 100.0), Rate(100.0, 200.0), Rate(4.0, 20.0)
"""Limits on stops, camera pictures and new WebSockets, for each token in each network, as rates per
second and largest bursts. Requests beyond a limit wait. A page asks for at most 20 pictures a
second."""

STRANGER_RATE = Rate(30.0, 150.0)
"""Limit on requests without a valid token from one network, as a rate per second and a largest
burst. Requests beyond the limit wait. A phone loads the page with 16 requests, so eight phones
behind one address can load the page at the same time."""

HANDSHAKE_RATE = Rate(30.0, 100.0)
"""Limit on TLS handshakes per network, as a rate per second and a largest burst. Handshakes beyond
the limit wait. A browser needs six to load the page."""

REFUSAL_DELAY_S = 0.5
"""Delay of a request beyond a rate limit, s. Refusing the request immediately would not help,
because a refusal costs the server as much as an answer."""

MESSAGE_RATE = Rate(200.0, 400.0)
"""Limit on messages per WebSocket, as a rate per second and a largest burst. A client sends a burst
when its network returns."""

COMMAND_RATE = Rate(60.0, 120.0)
"""Limit on commands per token, or per WebSocket from the robot itself, as a rate per second and a
largest burst. The page's stick sends 20 commands a second, and the daemon accepts 1000 a second
from this server. Before this limit existed, 24 WebSockets with 180 commands a second each made the
daemon drop half of the commands of a client that was driving."""

GUESSES_OF_ONE, GUESSES = Rate(10 / 60, 10.0), Rate(100 / 60, 100.0)
"""Limits on wrong tokens, from one network and in total, as rates per second and largest bursts."""


C = TypeVar("C", bound=Hashable)


def sockets_for(files: int) -> int:
    """Return the maximum number of TCP connections from other machines.

    `files` is the number of files that this process may open.
    """
    # A connection needs two files while it fetches a recording.
    return max(
        MIN_TCP_CONNECTIONS,
        min(MAX_TCP_CONNECTIONS, (files - RESERVED_FILES) // 2 - MAX_LOCAL_TCP_CONNECTIONS),
    )


class Sockets(Generic[C]):
    """The open TCP connections, up to a maximum number.

    If the maximum is reached, each new connection displaces an older connection:

    1. If there are connections without a valid token, the network with the most of them loses its
       oldest connection without a valid token.
    2. If every connection has shown a valid token, the token with the most connections loses its
       oldest connection. However, if this token has at most `RESERVED_TCP_OF_TOKEN` connections,
       the new connection is refused instead.

    If a network has `MAX_TCP_OF_NETWORK` connections without a valid token, each new connection
    from this network displaces the oldest of them, even if the maximum is not reached.

    In these rules, a connection that exceeds `MAX_TCP_OF_TOKEN` counts as a connection without a
    valid token.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._strangers: dict[str, dict[C, None]] = {}
        """The connections without a valid token, by network, oldest first."""
        self._networks: dict[C, str] = {}
        self._known: dict[C, str] = {}
        """Maps each connection that counts toward the limit of its token (`MAX_TCP_OF_TOKEN`) to
        this token."""
        self._shown: dict[C, str] = {}
        """The last valid token that each connection has shown. A connection beyond the limit
        `MAX_TCP_OF_TOKEN` is in this dict too."""
        self._tokens: Counter[str] = Counter()

    def enter(self, network: str, newcomer: C) -> C | None:
        """Add the new connection `newcomer`, and return the connection that the caller must close.

        Return None if the caller need not close any connection. If the new connection is refused,
        do not add it, and return `newcomer` itself. `network` is the network of the client.
        """
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
        """Remove the connection that must make room for a new connection, and return it.

        Return None if every connection has shown a valid token, and no token has more than
        `RESERVED_TCP_OF_TOKEN` connections.
        """
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
        """Record that the connection `connection` has shown the valid token `token`.

        `token` is "" for a client on the robot itself. A later token of the same connection
        replaces the earlier token, because a browser may get another token. If the later token has
        `MAX_TCP_OF_TOKEN` connections already, the connection still counts under the earlier token.
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
        """Return the connections whose token is not valid any more.

        `valid` contains all tokens that are valid now. If a connection has shown several tokens,
        the last of them counts.
        """
        return [
            connection for connection, token in self._shown.items() if token and token not in valid
        ]

    def strangers(self) -> list[C]:
        """Return the connections without a valid token, and those beyond `MAX_TCP_OF_TOKEN`."""
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
    """Limits the number of open WebSockets.

    WebSockets from the robot itself are counted separately.
    """

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
        """Count a new WebSocket and return "". If a limit forbids it, return reason and remedy."""
        if full := self.refusal(address, token):
            return full
        for places, name, _ in self._places(address, token):
            places.enter(name)
        return ""

    def leave(self, address: str, token: str) -> None:
        for places, name, _ in self._places(address, token):
            places.leave(name)

    def _places(self, address: str, token: str) -> list[tuple[Places, str, str]]:
        """Return a triple for each limit that applies to a WebSocket.

        The triple contains the limit, the name under which the limit counts the WebSocket, and the
        text for the client if the limit is reached.
        """
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
