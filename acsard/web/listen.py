"""Opens the addresses at which the page's server listens, and lists the URLs of the page."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence

from msgspec import Struct

from acsard.bus.tls_files import names_in, require_usable
from acsard.host.errors import CertificateError, InUseError, UsageError
from acsard.host.own_identity import own_addresses
from acsard.web.callers import is_loopback

# From the requested port on.
MAX_PORTS_TRIED = 20

# Wildcard addresses: all IPv4 addresses, and all IPv4 and IPv6 addresses of this machine.
EVERYWHERE_4, EVERYWHERE_6 = "0.0.0.0", "::"


class Listen(Struct, frozen=True):
    """An address at which the page's server listens."""

    secure: bool  # HTTPS
    host: str
    port: int

    @property
    def everywhere(self) -> bool:
        return self.host in (EVERYWHERE_4, EVERYWHERE_6)

    @property
    def url(self) -> str:
        """URL to open in a browser, with the machine's name for a wildcard address."""
        return self.url_at(own_name() if self.everywhere else self.host)

    def url_at(self, host: str) -> str:
        """Return the URL with another host."""
        host = f"[{host}]" if ":" in host else host
        return f"http{'s' if self.secure else ''}://{host}:{self.port}/"


def own_name() -> str:
    """Return the mDNS name of this machine."""
    return f"{socket.gethostname().partition('.')[0].lower()}.local"


def parse_listen(text: str) -> Listen:
    """Parse an address such as `https://0.0.0.0:8443`.

    Raises `UsageError` if it is not valid, or has the scheme `http` and is not a loopback address.
    """
    scheme, _, place = text.removesuffix("/").partition("://")
    host, _, port = place.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    number = int(port) if port.isascii() and port.isdecimal() else 0
    if scheme not in ("http", "https") or not host or not 0 < number < 65536:
        raise UsageError(
            f"{text} is not an address; write it like http://127.0.0.1:8080 or https://0.0.0.0:8443"
        )
    if scheme == "http" and not (host == "localhost" or is_loopback(host)):
        raise UsageError(
            f"{text}: use https, with the robot's certificate; http is only for this machine"
        )
    return Listen(scheme == "https", host, number)


def invitations(listen: Sequence[Listen], tls: str) -> list[str]:
    """Return the HTTPS URLs for other machines, the most likely one to work first.

    IP addresses come before names, because not every phone resolves mDNS names. Call
    `require_certificate` first; `tls` is the directory of the certificate.
    """
    urls: list[str] = []
    for address in listen:
        if not address.secure:
            continue
        hosts = [address.host]
        if address.everywhere:
            certified = names_in(tls)
            own = [at for at in own_addresses() if at in certified]
            # Not every network has IPv6, so IPv4 addresses come first.
            newer = [at for at in own if ":" in at and address.host == EVERYWHERE_6]
            hosts = [*(at for at in own if ":" not in at), *newer, own_name()]
        urls += [address.url_at(host) for host in hosts]
    return list(dict.fromkeys(urls))


def page_urls(address: Listen, tls: str) -> list[str]:
    """Return the URLs of the page at an address, the most reliable one first."""
    return invitations([address], tls) if address.secure else [address.url]


def require_certificate(listen: Sequence[Listen], tls: str) -> None:
    """Raise `MendableError` if an address uses HTTPS and `tls` has no usable certificate."""
    away = [address for address in listen if address.secure]
    if away and not tls:
        raise CertificateError(
            f"{away[0].url} needs a certificate: run `acsard tls init` to make it; then set "
            "bus.tls or give --tls DIRECTORY"
        )
    if away:
        require_usable(tls)


def open_sockets(listen: Sequence[Listen], next_port: bool) -> list[tuple[Listen, socket.socket]]:
    """Open a listening socket at each address; return pairs of the used address and the socket.

    If `next_port` is true, the next free port of `MAX_PORTS_TRIED` is used. Raises `InUseError`,
    and `UsageError` for another address at the port of `[::]`, which listens at all addresses.
    """
    for everywhere in listen:
        if everywhere.host != EVERYWHERE_6:
            continue
        for other in listen:
            if other.port == everywhere.port and other != everywhere:
                raise UsageError(
                    f"[::]:{other.port} listens at all addresses of this machine, IPv4 too: list "
                    f"it alone, without {other.host}:{other.port}, or choose another port"
                )
    return [_open_socket(address, next_port) for address in listen]


def _open_socket(addr: Listen, next_port: bool) -> tuple[Listen, socket.socket]:
    ports = range(addr.port, min(65536, addr.port + MAX_PORTS_TRIED)) if next_port else [addr.port]
    both = addr.host == EVERYWHERE_6 and socket.has_dualstack_ipv6()
    trouble: OSError | None = None
    for port in ports:
        try:
            info = socket.getaddrinfo(addr.host, port, type=socket.SOCK_STREAM)[0]
            opened = socket.create_server(
                info[4][:2], family=info[0], backlog=128, dualstack_ipv6=both
            )
        except OSError as error:
            trouble = error
            continue
        opened.setblocking(False)
        return Listen(addr.secure, addr.host, port), opened
    assert trouble is not None
    # The text of `create_server` repeats the address as a Python tuple. Errors of the name
    # resolution have negative numbers.
    number = trouble.errno or 0
    why = os.strerror(number) if number > 0 else trouble.strerror
    raise InUseError(
        f"cannot listen at {addr.url}: {why}; if another program uses this address, such as a "
        "daemon that serves its page there, stop that program, or choose another address with "
        "--address or the setting web.address"
    ) from None
