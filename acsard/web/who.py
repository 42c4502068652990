"""Who speaks, by where he comes from and what his browser says of the page it shows; pure.

Who is at the machine is its maintainer. But any page in his browser may open `ws://localhost`, or
point a name of its own at 127.0.0.1: so the name in `Host` must be a loopback one, and where the
browser tells of a page (`Origin`), it must be ours. From beyond the machine one comes by HTTPS, to
a name that the robot has, with a token. Nobody comes through a proxy: on the robot, with the `Host`
rewritten, it would make a maintainer of everybody behind it.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Collection, Mapping
from typing import Literal

from msgspec import Struct

from acsard.values import ROLES, Role

Reason = Literal[
    "host", "origin", "no_token", "bad_token", "plain", "role", "too_many", "too_fast",
    "too_big", "malformed", "path", "replayed", "crowded", "slow", "proxy", "stuck",
]  # fmt: skip
"""What a refusal is counted under."""

Place = Literal["here", "away"]

HERE = "here"
"""The name of who needs none."""

COOKIE = "__Host-acsard"
"""How our cookies' names begin: by that browsers take them only with Secure, of this host, for all
paths."""

MOST_COOKIES = 8
"""So many are looked at."""


class Who(Struct, frozen=True):
    """Somebody who may come in."""

    role: Role
    name: str
    token: str = ""
    """What his token is known by; "" for one at the machine."""
    address: str = ""
    """Where he comes from."""

    @property
    def origin(self) -> str:
        """Address and name, as the log tells whom it refused."""
        return f"{self.address} ({self.name})" if self.token else self.address

    def may(self, least: Role) -> bool:
        """Has he at least this role?"""
        return ROLES.index(self.role) >= ROLES.index(least)


MAINTAINER = Who("maintainer", HERE)
"""Who is at the machine."""


class Refusal(Struct, frozen=True):
    """Why not, and what to do instead."""

    reason: Reason
    text: str


class Asked(Struct, frozen=True):
    """What is known of a request before anything in it is believed."""

    peer: str
    """The address it comes from."""
    secure: bool
    """By TLS."""
    host: str
    """The `Host` header."""
    origin: str | None = None
    """The `Origin` header, where there is one."""
    site: str | None = None
    """`Sec-Fetch-Site`."""
    proxied: bool = False
    """By somebody who hands it on, and says so."""


def place(asked: Asked, names: Collection[str]) -> Place | Refusal:
    """Where a request comes from; `names` are those of the robot, lower case."""
    if asked.proxied:
        return Refusal(
            "proxy",
            "through a proxy everybody would look as if he were at the machine: open this page "
            "without one, from elsewhere by https",
        )
    host = host_name(asked.host)
    if is_loopback(asked.peer) and (host == "localhost" or is_loopback(host)):
        return "here"
    if not asked.secure:
        return Refusal(
            "plain" if not is_loopback(asked.peer) else "host",
            f"{host or 'no name'!r} is not a name of this machine for itself: "
            "use http://localhost here, and https from elsewhere",
        )
    if host not in names:
        return Refusal("host", f"{host or 'no name'!r} is not a name that this robot has")
    return "away"


def foreign(asked: Asked) -> Refusal | None:
    """A page that is not ours has its browser ask."""
    own = f"{'https' if asked.secure else 'http'}://{asked.host}".lower()
    strange = asked.origin is not None and asked.origin.lower() != own
    if strange or asked.site not in (None, "same-origin", "none"):
        return Refusal("origin", "a page of another origin may not do that")
    return None


def cookie_name(robot: str, port: int) -> str:
    """What the cookie of this page is called: a browser sends those of all ports of a host to each,
    and keeps one of each name."""
    return f"{COOKIE}-{robot}-{port}"


def tokens_in(cookies: Mapping[str, str], robot: str, port: int) -> list[str]:
    """The tokens in a browser's cookies that may be for this page: its own, then those of the same
    robot at other ports, and of before cookies were told apart."""
    own, ours = cookie_name(robot, port), f"{COOKIE}-{robot}"
    names = [name for name in cookies if name == COOKIE or name.rpartition("-")[0] == ours]
    return [cookies[name] for name in sorted(names, key=lambda name: name != own)][:MOST_COOKIES]


def host_name(host: str) -> str:
    """The name or address in a `Host` header, lower case, without its port."""
    if host.startswith("["):
        return host[1:].partition("]")[0].lower()
    return host.partition(":")[0].lower()


def unmapped(address: str) -> str:
    """An IPv4 address as such, also of one who came by it to a socket for both."""
    return address.removeprefix("::ffff:") if "." in address else address


def is_loopback(text: str) -> bool:
    """An address of this machine for itself; no name is."""
    try:
        address = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return False
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_loopback
