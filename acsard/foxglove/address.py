"""The address that viewers connect to: `HOST:PORT`, on this machine only."""

from __future__ import annotations

import ipaddress

from acsard.host.errors import UsageError

DEFAULT = "127.0.0.1:8765"
"""The address that Foxglove and Lichtblick try by default."""


def loopback(text: str) -> tuple[str, int]:
    """Return host and port.

    Raises `UsageError` for a malformed address and for one that other machines can reach.
    """
    host, _, digits = text.rpartition(":")
    try:
        address = ipaddress.IPv4Address("127.0.0.1" if host == "localhost" else host)
        port = int(digits)
    except ValueError:
        raise UsageError(f"{text} is not an address: write it like {DEFAULT}") from None
    if not 0 < port < 65536:
        raise UsageError(f"{text}: a port is a number from 1 to 65535")
    if not address.is_loopback:
        raise UsageError(
            f"other machines could reach {text}, but this protocol has no authentication: every "
            f"client that connects could drive. Listen on {DEFAULT} and, on the other machine, "
            f"open a tunnel: ssh -N -L {port}:127.0.0.1:{port} USER@ROBOT"
        )
    return str(address), port
