"""Creates the certificates of the authority, of the robot and of its clients, and renews them.

The robot admits clients whose certificate its authority has signed. The common name determines
their permissions (`[access]`).
"""

from __future__ import annotations

import os
import re
import shlex
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from acsard.bus.tls_files import CA, CERTIFICATE, KEY
from acsard.core.config.settings import Config, is_tls
from acsard.core.values import ROLES
from acsard.host.errors import MendableError, NotPermittedError
from acsard.host.extras import missing
from acsard.host.own_identity import own_addresses

if TYPE_CHECKING:
    from acsard.machine.authority import Authority

PORT = 7449
CA_KEY = "ca-key.pem"  # never copied to a client

ROBOT_NAME = "robot"  # common name of the robot's own certificate

# A host name or an IP address.
ADDRESS = re.compile(r"[A-Za-z0-9:]([A-Za-z0-9.:-]{0,251}[A-Za-z0-9:])?\Z")

LABEL = r"[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?"
# A common name that looks like a host name or an address.
HOST_LIKE = re.compile(rf"{LABEL}(\.{LABEL})*\Z")


def init(directory: Path, addresses: Sequence[str], days: int, *, force: bool) -> list[str]:
    """Create an authority, the robot's certificate and a client certificate for each role.

    Return the names and addresses in the robot's: this machine's and `addresses`. `force` replaces
    existing files. Raises `MendableError`.
    """
    for name in () if force else (CA, CA_KEY, CERTIFICATE, KEY):
        if (directory / name).exists():
            raise MendableError(
                f"{directory / name} exists: to make one more client certificate with an "
                "authority, use `acsard tls add`; --force makes a new authority, and then the "
                "daemon refuses all certificates of the old authority",
            )
    maker = _maker()
    _writable(directory)
    try:
        directory.mkdir(mode=0o755, parents=True, exist_ok=True)
    except OSError as error:
        raise MendableError(f"cannot make {directory}: {error.strerror}") from None
    names = _robot_names(addresses)
    authority = maker.make(directory, f"acsard at {socket.gethostname()}", days, names)
    authority.issue(directory, ROBOT_NAME, names, days)
    for role in ROLES:
        authority.issue(directory / "clients" / role, role, [], days)
    return names


def add(directory: Path, name: str, addresses: Sequence[str], days: int) -> Path:
    """Create a client certificate, and return its directory.

    Raises `MendableError`: it exists, or the authority is unusable or may not sign this.
    """
    authority = _load(directory)
    place = directory / "clients" / name
    if place.exists():
        raise MendableError(f"{place} exists; remove it, or choose another name")
    _require_permitted(authority, addresses)
    named = [host for host in _names_of(name) if authority.permits(host)]
    authority.issue(place, name, [*named, *addresses], days)
    return place


def renew_client(directory: Path, name: str, addresses: Sequence[str], days: int) -> Path:
    """Replace a client's certificate, and return its directory.

    The old names and addresses stay if permitted. Raises `MendableError`.
    """
    authority = _load(directory)
    clients = directory / "clients"
    place = clients / name
    if not (place / CERTIFICATE).is_file():
        there = sorted(entry.parent.name for entry in clients.glob(f"*/{CERTIFICATE}"))
        raise MendableError(
            f"{clients} has no certificate for {name}, only for: {', '.join(there) or 'nobody'}; "
            f"`acsard tls add {shlex.quote(name)} --directory {shlex.quote(str(directory))}` makes "
            "this certificate"
        )
    _require_permitted(authority, addresses)
    old_names = [entry for entry in authority.names_in(place) if authority.permits(entry)]
    authority.issue(place, name, [*old_names, *addresses], days)
    return place


def renew(directory: Path, addresses: Sequence[str], days: int) -> list[str]:
    """Replace the robot's certificate; return the names and addresses in the new one.

    Those of this machine and of the old one are included if permitted. Raises `MendableError`.
    """
    authority = _load(directory)
    _require_permitted(authority, addresses)
    known = _robot_names(authority.names_in(directory))
    # The name or address of this machine may have changed since the authority was made. The
    # authority may not sign for the new one then.
    names = [*filter(authority.permits, known), *addresses]
    authority.issue(directory, ROBOT_NAME, names, days)
    return list(dict.fromkeys(names))


def _names_of(name: str) -> list[str]:
    # If a certificate contains no host name, OpenSSL treats its common name, such as `a.person`,
    # as a host name. If the authority may not sign for this host name, OpenSSL refuses the
    # certificate.
    named = [name] if ADDRESS.match(name) else []
    if not HOST_LIKE.match(name) or name.endswith(".local"):
        return named
    return [*named, f"{name}.local"]


def _require_permitted(authority: Authority, addresses: Sequence[str]) -> None:
    barred = [address for address in addresses if not authority.permits(address)]
    if barred:
        named = " ".join(f"--address {address}" for address in barred)
        raise MendableError(
            f"the certificate authority may not sign a certificate for {', '.join(barred)}: the "
            "authority's own certificate permits only private networks, .local names, and the "
            "names and addresses that were given to `acsard tls init`. `acsard tls init --force "
            f"{named}` makes a new authority; then every client needs a new certificate",
        )


def _robot_names(more: Sequence[str]) -> list[str]:
    host = socket.gethostname()
    names = [host, f"{host}.local", "localhost", "127.0.0.1", *own_addresses(), *more]
    return list(dict.fromkeys(names))


def keys(config: Config, directory: Path) -> dict[str, object]:
    """Return `bus.listen`, with a TLS endpoint at `PORT` if it has none, and `bus.tls`."""
    listen = list(config.bus.listen)
    if not any(map(is_tls, listen)):
        listen.append(f"tls/0.0.0.0:{PORT}")
    return {"bus.listen": listen, "bus.tls": str(directory)}


def port(config: Config) -> str:
    """Return the TCP port of the first TLS endpoint, or `PORT`, as `keys` sets it."""
    ports = [at.rpartition(":")[2] for at in config.bus.listen if is_tls(at)]
    return ports[0] if ports else str(PORT)


def _maker() -> type[Authority]:
    try:
        from acsard.machine.authority import Authority
    except ImportError:
        raise missing("cryptography") from None
    return Authority


def _load(directory: Path) -> Authority:
    maker = _maker()
    _writable(directory)
    try:
        return maker.load(directory)
    except FileNotFoundError:
        if (directory / CA).exists():
            text = (
                f"{directory} has no {CA_KEY}: first copy the key of the certificate authority "
                "back into that directory"
            )
        else:
            text = (
                f"{directory} has no certificate authority: name the directory that contains "
                f"{CA_KEY} with --directory; if you have no authority yet, run `acsard tls init` "
                "first"
            )
        raise MendableError(text) from None
    except (OSError, ValueError, TypeError) as error:
        raise MendableError(
            f"cannot use the certificate authority in {directory}: {error}"
        ) from None


def _writable(directory: Path) -> None:
    # `exists` is false for a symbolic link to a missing file, which is in the way all the same.
    places = (directory, *directory.absolute().parents)
    there = next(place for place in places if place.exists() or place.is_symlink())
    if not there.is_dir():
        raise MendableError(f"{there} is not a directory; name a directory with --directory")
    if not os.access(there, os.W_OK | os.X_OK):
        raise NotPermittedError(
            f"cannot write to {there}: run this command with sudo, or name another directory with "
            "--directory"
        )
