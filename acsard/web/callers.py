"""Identifies the client of a request, and checks the client's role. This module is pure.

A client on the robot needs no token and has the role in `web.local`. Any web page there may open
`ws://localhost` or let its own name point to 127.0.0.1, so `Host` must be a loopback name, and an
`Origin` that of the page or of `web.origins`. Any other client must use HTTPS, a name of the robot
and a token. A proxy is refused, because its clients could look local.
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
    "too_big", "malformed", "path", "crowded", "slow", "proxy",
]  # fmt: skip

Place = Literal["here", "away"]

# Name of each client on the robot itself. Any other has the name of its token.
LOCAL_NAME = "here"

# Browsers take `__Host-` only with `Secure` and `Path=/` and without `Domain`.
COOKIE_PREFIX = "__Host-acsard"

# The WebSocket subprotocol, and the prefix of a further one that contains a token.
PROTOCOL, TOKEN = "acsard", "acsard.token."

# checked in one request; further ones are ignored
MAX_TOKENS = 8


class RequestRefusedError(AcsardError):
    """A request or message of a client is refused; the text has the reason and the remedy."""

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.reason = reason


class AdmittedClient(Struct, frozen=True):
    """The identity of an admitted client."""

    role: Role
    name: str
    token: str = ""  # digest; "" on the robot itself
    address: str = ""

    @property
    def origin(self) -> str:
        """Address, and the name of the token, for the log."""
        return f"{self.address} ({self.name})" if self.token else self.address

    def may(self, least: Role) -> bool:
        return has(self.role, least)

    def require(self, least: Role, what: str) -> None:
        """Raise `RequestRefusedError` if the client's role is too low for the action `what`."""
        if not self.may(least):
            raise RequestRefusedError(
                "role", f"{what} is {self.why_not_allowed(least)}: {ROLE_TEXTS[self.role]}"
            )

    def why_not_allowed(self, least: Role) -> str:
        """Return why the client's role is too low for an action of the role `least`."""
        return f"for {least}s; your role is {self.role}"


class RequestFacts(Struct, frozen=True):
    """What decides whether a request is admitted. A client may forge all headers."""

    peer: str  # source address of the connection
    secure: bool  # TLS
    host: str  # header `Host`; "" if missing or malformed
    origin: str | None = None  # header `Origin`
    site: str | None = None  # header `Sec-Fetch-Site`
    proxied: bool = False  # a header says that a proxy forwarded the request


def place(facts: RequestFacts, names: Collection[str]) -> Place:
    """Return "here" for a client on the robot that requests a loopback name, otherwise "away".

    Raises `RequestRefusedError` after a proxy, and if a client that is away uses plain HTTP or a
    host that is not in `names` (lower case).
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
    """Return whether a page of an origin in `web.origins` made the browser send this request.

    The server ignores its cookies. The robot's own page is never such a page, because its cookies
    count.
    """
    if facts.origin is None or facts.origin.lower() == _own_origin(facts):
        return False
    return facts.origin.lower() in origins


def _own_origin(facts: RequestFacts) -> str:
    return f"{'https' if facts.secure else 'http'}://{facts.host}".lower()


def tokens_offered(protocols: str) -> list[str]:
    """Return the tokens in `Sec-WebSocket-Protocol`.

    A script can set no other header when it opens a WebSocket.
    """
    offered = (name.strip() for name in protocols.split(","))
    return [name.removeprefix(TOKEN) for name in offered if name.startswith(TOKEN)][:MAX_TOKENS]


def cookie_name(robot: str, port: int) -> str:
    """Return the name of a cookie.

    A browser sends it to all ports of a host, so each has another name.
    """
    return f"{COOKIE_PREFIX}-{robot}-{port}"


def tokens_in(cookies: Mapping[str, str], robot: str, port: int) -> list[str]:
    """Return the tokens in the robot's cookies, that of the port `port` first."""
    own, ours = cookie_name(robot, port), f"{COOKIE_PREFIX}-{robot}"
    names = [name for name in cookies if name.rpartition("-")[0] == ours]
    return [cookies[name] for name in sorted(names, key=lambda name: name != own)][:MAX_TOKENS]


def host_name(host: str) -> str:
    """Return the host of a `Host` header in lower case, without port and brackets."""
    if host.startswith("["):
        return host[1:].partition("]")[0].lower()
    return host.partition(":")[0].lower()


def unmapped(address: str) -> str:
    """Return an address without the `::ffff:` of a dual-stack socket."""
    return address.removeprefix("::ffff:") if "." in address else address


def network_of(address: str) -> str:
    """Return the IPv4 address itself, or the /64 network of an IPv6 address.

    One machine may use a whole /64 network.
    """
    if ":" not in address:
        return address
    return str(ipaddress.ip_network((address.partition("%")[0], 64), strict=False))


def is_loopback(text: str) -> bool:
    """Return whether a text is a loopback IP address; no host name is."""
    try:
        address = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return False
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_loopback
