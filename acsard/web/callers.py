"""Identifies the client of a request, and checks the client's role. This module is pure.

A client on the robot itself needs no token and has the role in `web.local`. However, any web page
in a browser on the robot may open `ws://localhost`, or may let its own host name point to
127.0.0.1. So the header `Host` must be a loopback name. If there is a header `Origin`, it must be
the origin of the robot's own page, or an origin in `web.origins`.

A client on another machine must use HTTPS, a name or address of the robot, and a token. A request
through a proxy is refused, because a proxy on the robot that rewrites `Host` would make all of its
clients look local.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Collection, Mapping
from typing import Literal

from msgspec import Struct

from acsard.core.messages.permissions import ROLE_TEXTS, has
from acsard.core.values import AcsardError, Role

Reason = Literal[
    "host", "origin", "no_token", "bad_token", "plain", "role", "too_many", "too_fast",
    "too_big", "malformed", "path", "replayed", "crowded", "slow", "proxy", "stuck",
]  # fmt: skip
"""Reason for the refusal of a request, message or connection. The server counts refusals by
reason."""

Place = Literal["here", "away"]

LOCAL_NAME = "here"
"""Name of each client on the robot itself. Any other client has the name of its token."""

COOKIE_PREFIX = "__Host-acsard"
"""Prefix of the cookie names. Browsers accept a cookie with the prefix `__Host-` only if it has the
attributes `Secure` and `Path=/` and no attribute `Domain`."""

PROTOCOL, TOKEN = "acsard", "acsard.token."
"""Name of the WebSocket subprotocol (`PROTOCOL`), and prefix of a further subprotocol name that
contains a client's token (`TOKEN`)."""

MAX_TOKENS = 8
"""Maximum number of tokens that the server checks in one request. It ignores further tokens."""


class RequestRefusedError(AcsardError):
    """A request or message of a client is refused. The text gives the reason and the remedy."""

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.reason = reason


class AdmittedClient(Struct, frozen=True):
    """The identity of an admitted client."""

    role: Role
    name: str
    token: str = ""
    """Digest of the client's token; "" for a client on the robot itself."""
    address: str = ""

    @property
    def origin(self) -> str:
        """The client's address, followed by the name if the client has a token, for the log."""
        return f"{self.address} ({self.name})" if self.token else self.address

    def may(self, least: Role) -> bool:
        return has(self.role, least)

    def require(self, least: Role, what: str) -> None:
        """Raise `RequestRefusedError` if the client's role is lower than `least`.

        `what` is the name of the action that requires the role `least`, for the error message.
        """
        if not self.may(least):
            raise RequestRefusedError(
                "role", f"{what} is {self.why_not_allowed(least)}: {ROLE_TEXTS[self.role]}"
            )

    def why_not_allowed(self, least: Role) -> str:
        """Return the reason why the client may not use an action that requires the role `least`.

        Call this only for a client whose role is lower.
        """
        return f"for {least}s; your role is {self.role}"


class RequestFacts(Struct, frozen=True):
    """The properties of a request that decide whether the server admits the request.

    A client may forge all headers.
    """

    peer: str
    """Source IP address of the connection."""
    secure: bool
    """True if the connection uses TLS."""
    host: str
    """Value of the `Host` header, "" if it is missing or malformed."""
    origin: str | None = None
    """Value of the `Origin` header, if there is one."""
    site: str | None = None
    """Value of the `Sec-Fetch-Site` header, if there is one."""
    proxied: bool = False
    """True if a header says that a proxy forwarded the request."""


def place(facts: RequestFacts, names: Collection[str]) -> Place:
    """Return "here" if the client is on the robot and requests a loopback name, otherwise "away".

    `names` are the robot's names and addresses, in lower case.

    Raises `RequestRefusedError` in three cases:

    - The request came through a proxy.
    - The client is "away" and uses plain HTTP.
    - The client is "away" and requests a host that is not in `names`.
    """
    if facts.proxied:
        raise RequestRefusedError(
            "proxy",
            "the request came through a proxy, which hides the machine of the browser: open this "
            "page without a proxy, and with https if the browser runs on another machine",
        )
    host = host_name(facts.host)
    if is_loopback(facts.peer) and (host == "localhost" or is_loopback(host)):
        return "here"
    if not facts.secure:
        raise RequestRefusedError(
            "plain" if not is_loopback(facts.peer) else "host",
            f"the request is for {host or 'no host'!r}, but plain http is only for localhost: use "
            "http://localhost on the machine of the page's server, and https from another machine",
        )
    if host not in names:
        raise RequestRefusedError(
            "host",
            f"{host or 'no name'!r} is not a name of this robot: use its host name, its address or "
            "a name in its certificate",
        )
    return "away"


def require_own_origin(facts: RequestFacts) -> None:
    """Raise `RequestRefusedError` if a page of another origin caused this request."""
    strange = facts.origin is not None and facts.origin.lower() != _own_origin(facts)
    if strange or facts.site not in (None, "same-origin", "none"):
        raise RequestRefusedError(
            "origin",
            "the request comes from a page of another site: open the robot's own page, or list the "
            "site in web.origins",
        )


def by_listed_page(facts: RequestFacts, origins: Collection[str]) -> bool:
    """Return whether a web page of an origin in `web.origins` made the browser send this request.

    `origins` are the origins in `web.origins`. The server ignores the cookies of such a page, but
    it must accept the cookies of the robot's own page. So return False for the robot's own page,
    even if `web.origins` contains its origin.
    """
    if facts.origin is None or facts.origin.lower() == _own_origin(facts):
        return False
    return facts.origin.lower() in origins


def _own_origin(facts: RequestFacts) -> str:
    return f"{'https' if facts.secure else 'http'}://{facts.host}".lower()


def tokens_offered(protocols: str) -> list[str]:
    """Return the tokens in `protocols`, the value of the header `Sec-WebSocket-Protocol`.

    A script in a browser sends its token in this header, because it cannot set any other header
    when it opens a WebSocket.
    """
    offered = (name.strip() for name in protocols.split(","))
    return [name.removeprefix(TOKEN) for name in offered if name.startswith(TOKEN)][:MAX_TOKENS]


def cookie_name(robot: str, port: int) -> str:
    """Return the name of the cookie for the page of the robot `robot` at the TCP port `port`.

    A browser sends the cookies of a host to all ports of the host. So each port needs another name.
    """
    return f"{COOKIE_PREFIX}-{robot}-{port}"


def tokens_in(cookies: Mapping[str, str], robot: str, port: int) -> list[str]:
    """Return the tokens in the cookies of the robot `robot`, at most `MAX_TOKENS`.

    The token for the page at the TCP port `port` comes first. The others are for other ports.
    """
    own, ours = cookie_name(robot, port), f"{COOKIE_PREFIX}-{robot}"
    names = [name for name in cookies if name.rpartition("-")[0] == ours]
    return [cookies[name] for name in sorted(names, key=lambda name: name != own)][:MAX_TOKENS]


def host_name(host: str) -> str:
    """Return the host name or address in the value of a `Host` header.

    The result is in lower case, and has no port and no brackets.
    """
    if host.startswith("["):
        return host[1:].partition("]")[0].lower()
    return host.partition(":")[0].lower()


def unmapped(address: str) -> str:
    """Return an IP address without the prefix `::ffff:` of an IPv4 address in IPv6 notation.

    A dual-stack socket adds this prefix to the address of an IPv4 client.
    """
    return address.removeprefix("::ffff:") if "." in address else address


def network_of(address: str) -> str:
    """Return the network for which the server counts the connections of an IP address.

    This is an IPv4 address itself, or the /64 network of an IPv6 address, because one machine may
    use all addresses of a /64 network.
    """
    if ":" not in address:
        return address
    try:
        return str(ipaddress.ip_network((address.partition("%")[0], 64), strict=False))
    except ValueError:
        return address


def is_loopback(text: str) -> bool:
    """Return whether the text is a loopback IP address. Return False for every host name."""
    try:
        address = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return False
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_loopback
