"""Who has which certificate: a directory with the robot's own, the authority, and all clients'.

The robot lets in who has a certificate of its authority, and the common name in it decides what
they may do (`[access]`).
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

from acsard.bus.certificates import CA
from acsard.config.settings import Config
from acsard.host.addresses import own_addresses
from acsard.host.exits import Exit, ExitError
from acsard.host.extras import install
from acsard.values import ROLES

if TYPE_CHECKING:
    from acsard.lan.authority import Authority

PORT = 7449
CA_KEY = "ca-key.pem"
"""The authority's, which no client has."""


ADDRESS = re.compile(r"[A-Za-z0-9:]([A-Za-z0-9.:-]{0,251}[A-Za-z0-9:])?\Z")
"""A host name or IP address."""


def init(directory: Path, addresses: Sequence[str], days: int, *, force: bool) -> list[str]:
    """Make an authority, the robot's certificate and one for each role; the robot's names."""
    if (directory / CA).exists() and not force:
        raise ExitError(
            Exit.FAILURE,
            f"{directory / CA} exists: `acsard lan add` makes one more certificate with it; "
            "--force makes a new authority, and all certificates of the old one are refused then",
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
    """Make one more client's certificate; where it is."""
    authority = _load(directory)
    place = directory / "clients" / name
    if place.exists():
        raise ExitError(Exit.FAILURE, f"{place} exists; remove it, or choose another name")
    named = [name] if ADDRESS.match(name) else []
    authority.issue(place, name, [*named, *addresses], days)
    return place


def renew(directory: Path, addresses: Sequence[str], days: int) -> list[str]:
    """Replace the robot's own certificate; the names and addresses it has, the old ones too."""
    authority = _load(directory)
    names = [*_robot_names(authority.names_in(directory)), *addresses]
    authority.issue(directory, "robot", names, days)
    return list(dict.fromkeys(names))


def _robot_names(more: Sequence[str]) -> list[str]:
    """What the robot is reached by: from elsewhere, by mDNS, on itself, by its addresses now."""
    host = socket.gethostname()
    names = [host, f"{host}.local", "localhost", "127.0.0.1", *own_addresses(), *more]
    return list(dict.fromkeys(names))


def keys(config: Config, directory: Path) -> dict[str, object]:
    """The keys by which the bus leaves the machine; where it does so already, it stays there."""
    listen = list(config.bus.listen)
    if not any(endpoint.startswith("tls/") for endpoint in listen):
        listen.append(f"tls/0.0.0.0:{PORT}")
    return {"bus.listen": listen, "bus.tls": str(directory)}


def _maker() -> type[Authority]:
    try:
        from acsard.lan.authority import Authority
    except ImportError:
        raise ExitError(
            Exit.FAILURE, f"needs the library cryptography; run: {install('lan')}"
        ) from None
    return Authority


def _load(directory: Path) -> Authority:
    """The authority there, once we know that we may write beside it."""
    maker = _maker()
    _writable(directory)
    try:
        return maker.load(directory, _password)
    except FileNotFoundError:
        raise ExitError(
            Exit.FAILURE, f"no authority in {directory}: run `acsard lan init` first"
        ) from None
    except (OSError, ValueError) as error:
        raise ExitError(Exit.FAILURE, f"cannot use the authority in {directory}: {error}") from None


def _password() -> str:
    """Of an authority's key that somebody has encrypted."""
    if not sys.stdin.isatty():
        raise ExitError(
            Exit.USAGE,
            "the authority's key is encrypted: run it in a terminal, it asks for the password",
        )
    return getpass(f"password of {CA_KEY}: ")


def _writable(directory: Path) -> None:
    """We may make it, or write to it; nothing is made yet."""
    there = next(place for place in (directory, *directory.absolute().parents) if place.exists())
    if not there.is_dir():
        raise ExitError(Exit.FAILURE, f"{there} is not a directory; use --directory")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ExitError(
            Exit.NO_PERMISSION, f"cannot write to {there}: run it by sudo, or use --directory"
        )
