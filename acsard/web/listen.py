"""Where the page listens: addresses as they are written, opened, and written on an invitation."""

from __future__ import annotations

import socket
from collections.abc import Sequence

from msgspec import Struct

from acsard.bus.certificates import names_in, require_usable
from acsard.host.addresses import own_addresses
from acsard.host.errors import CertificateError, InUseError, UsageError
from acsard.web.who import is_loopback

TRIES = 20
"""Ports after a taken one that are tried."""

BACKLOG = 128

EVERYWHERE_4, EVERYWHERE_6 = "0.0.0.0", "::"
"""All addresses of this machine: those of IPv4, and all there are."""


class Listen(Struct, frozen=True):
    """Where to listen, and how."""

    secure: bool
    """HTTPS."""
    host: str
    port: int

    @property
    def everywhere(self) -> bool:
        """At all addresses of this machine."""
        return self.host in (EVERYWHERE_4, EVERYWHERE_6)

    @property
    def url(self) -> str:
        """What to open in a browser; where it is everywhere by the name of this machine."""
        return self.url_at(own_name() if self.everywhere else self.host)

    def url_at(self, host: str) -> str:
        """The same by another name."""
        host = f"[{host}]" if ":" in host else host
        return f"http{'s' if self.secure else ''}://{host}:{self.port}/"


def own_name() -> str:
    """What others find this machine by, by mDNS."""
    return f"{socket.gethostname().partition('.')[0].lower()}.local"


def listens(text: str) -> Listen:
    """An address like http://127.0.0.1:8080; raises `UsageError`.

    Without TLS nobody but this machine is listened to.
    """
    scheme, _, place = text.removesuffix("/").partition("://")
    host, _, port = place.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    number = int(port) if port.isascii() and port.isdecimal() else 0
    if scheme not in ("http", "https") or not host or not 0 < number < 65536:
        raise UsageError(
            f"{text} is no address; write it like http://127.0.0.1:8080 or https://0.0.0.0:8443"
        )
    if scheme == "http" and not (host == "localhost" or is_loopback(host)):
        raise UsageError(f"{text}: beyond this machine only https, with the robot's certificate")
    return Listen(scheme == "https", host, number)


def invitations(listen: Sequence[Listen], tls: str) -> list[str]:
    """The addresses to write on an invitation, the likeliest first; none without HTTPS.

    `tls` is the directory of the robot's certificate, as `require_certificate` takes it. An IP
    address before a name: not every phone asks by mDNS.
    """
    found: list[str] = []
    older_ports = _older_ports(listen)
    for one in listen:
        if not one.secure:
            continue
        hosts = [one.host]
        if one.everywhere:
            certified = names_in(tls)
            own = [at for at in own_addresses() if at in certified]
            # Not every network has IPv6, and 0.0.0.0 is not reached by it.
            both = one.host != EVERYWHERE_6 or one.port not in older_ports
            older = [at for at in own if ":" not in at and both]
            newer = [at for at in own if ":" in at and one.host == EVERYWHERE_6]
            hosts = [*older, *newer, own_name()]
        found += [one.url_at(host) for host in hosts]
    return list(dict.fromkeys(found))


def opened_by(one: Listen, tls: str) -> list[str]:
    """What opens it in a browser: from elsewhere what an invitation says."""
    return invitations([one], tls) if one.secure else [one.url]


def require_certificate(listen: Sequence[Listen], tls: str) -> None:
    """Raises a `MendableError` where one may come by HTTPS and there is nothing to show him."""
    away = [one for one in listen if one.secure]
    if away and not tls:
        raise CertificateError(
            f"{away[0].url} takes a certificate: `acsard lan init` makes one; then set bus.tls, or "
            "--tls DIRECTORY"
        )
    if away:
        require_usable(tls)


def bound(listen: Sequence[Listen], next_port: bool) -> list[tuple[Listen, socket.socket]]:
    """A socket at each, or at one of the next ports; raises `InUseError`."""
    older_ports = _older_ports(listen)
    return [_bound(one, next_port, one.port not in older_ports) for one in listen]


def _older_ports(listen: Sequence[Listen]) -> set[int]:
    """Those that somebody has by IPv4: `::` has them by IPv6 alone."""
    return {one.port for one in listen if ":" not in one.host}


def _bound(one: Listen, next_port: bool, both: bool) -> tuple[Listen, socket.socket]:
    """`both`: at `::` also by IPv4, which nobody else here has at this port."""
    ports = range(one.port, min(65536, one.port + TRIES)) if next_port else [one.port]
    both = both and one.host == EVERYWHERE_6 and socket.has_dualstack_ipv6()
    trouble: OSError | None = None
    for port in ports:
        try:
            found = socket.getaddrinfo(one.host, port, type=socket.SOCK_STREAM)[0]
            opened = socket.create_server(
                found[4][:2], family=found[0], backlog=BACKLOG, dualstack_ipv6=both
            )
        except OSError as error:
            trouble = error
            continue
        opened.setblocking(False)
        return Listen(one.secure, one.host, port), opened
    raise InUseError(
        f"cannot listen at {one.url}: {trouble}; stop what has it, or choose another "
        "by --address (web.address)"
    ) from None
