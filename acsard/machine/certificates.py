"""The directory of certificates: the robot's own, the authority, and those of all clients.

The robot admits clients with a certificate of its authority. The common name in the certificate
decides on their permissions (`[access]`).
"""

from __future__ import annotations

import os
import re
import socket
import sys
from collections.abc import Sequence
from getpass import getpass
from pathlib import Path
from typing import TYPE_CHECKING

from acsard.core.config.settings import Config
from acsard.core.values import ROLES
from acsard.daemon.bus.tls import CA
from acsard.host.errors import Exit, ExitError
from acsard.host.extras import missing
from acsard.host.own_identity import own_addresses

if TYPE_CHECKING:
    from acsard.machine.authority import Authority

PORT = 7449
CA_KEY = "ca-key.pem"
"""Key of the authority. Clients do not get it."""


ADDRESS = re.compile(r"[A-Za-z0-9:]([A-Za-z0-9.:-]{0,251}[A-Za-z0-9:])?\Z")
"""Matches a host name or an IP address."""


def init(directory: Path, addresses: Sequence[str], days: int, *, force: bool) -> list[str]:
    """Create an authority, the robot's certificate and one for each role.

    Returns the robot's names.
    """
    if (directory / CA).exists() and not force:
        raise ExitError(
            Exit.FAILURE,
            f"{directory / CA} exists: `acsard tls add` makes one more certificate with it; "
            "--force makes a new authority, and then the daemon refuses all certificates of the "
            "old one",
        )
    maker = _maker()
    _writable(directory)
    authority = maker.make(directory, f"acsard at {socket.gethostname()}", days)
    names = _robot_names(addresses)
    authority.issue(directory, "robot", names, days)
    for role in ROLES:
        authority.issue(directory / "clients" / role, role, [], days)
    return names


def add(directory: Path, name: str, addresses: Sequence[str], days: int) -> Path:
    """Create one more client certificate, and return its directory."""
    authority = _load(directory)
    place = directory / "clients" / name
    if place.exists():
        raise ExitError(Exit.FAILURE, f"{place} exists; remove it, or choose another name")
    named = [name] if ADDRESS.match(name) else []
    authority.issue(place, name, [*named, *addresses], days)
    return place


def renew(directory: Path, addresses: Sequence[str], days: int) -> list[str]:
    """Replace the robot's own certificate.

    Returns its names and addresses, with those of the old one.
    """
    authority = _load(directory)
    names = [*_robot_names(authority.names_in(directory)), *addresses]
    authority.issue(directory, "robot", names, days)
    return list(dict.fromkeys(names))


def _robot_names(more: Sequence[str]) -> list[str]:
    """Return the robot's names: for DNS, mDNS and itself, its present addresses, `more`."""
    host = socket.gethostname()
    names = [host, f"{host}.local", "localhost", "127.0.0.1", *own_addresses(), *more]
    return list(dict.fromkeys(names))


def keys(config: Config, directory: Path) -> dict[str, object]:
    """Return the settings that open the bus to the network. Existing TLS endpoints stay."""
    listen = list(config.bus.listen)
    if not any(endpoint.startswith("tls/") for endpoint in listen):
        listen.append(f"tls/0.0.0.0:{PORT}")
    return {"bus.listen": listen, "bus.tls": str(directory)}


def _maker() -> type[Authority]:
    try:
        from acsard.machine.authority import Authority
    except ImportError:
        raise missing("cryptography", "tls") from None
    return Authority


def _load(directory: Path) -> Authority:
    """Load the authority from `directory`, after a check that certificates can be written there."""
    maker = _maker()
    _writable(directory)
    try:
        return maker.load(directory, _password)
    except FileNotFoundError:
        raise ExitError(
            Exit.FAILURE, f"{directory} has no authority: run `acsard tls init` first"
        ) from None
    except (OSError, ValueError) as error:
        raise ExitError(Exit.FAILURE, f"cannot use the authority in {directory}: {error}") from None


def _password() -> str:
    """Ask for the password of an encrypted authority key."""
    if not sys.stdin.isatty():
        raise ExitError(
            Exit.USAGE,
            "the authority's key is encrypted: run this in a terminal, where it asks for the "
            "password",
        )
    return getpass(f"password of {CA_KEY}: ")


def _writable(directory: Path) -> None:
    """Raise `ExitError` unless the directory can be created or written to.

    Nothing is created yet.
    """
    there = next(place for place in (directory, *directory.absolute().parents) if place.exists())
    if not there.is_dir():
        raise ExitError(Exit.FAILURE, f"{there} is not a directory; use --directory")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ExitError(
            Exit.NO_PERMISSION, f"cannot write to {there}: run it with sudo, or use --directory"
        )
