"""The names and addresses of this process and its machine, as others see them."""

from __future__ import annotations

import ipaddress
import json
import os
import pwd
import secrets
import subprocess
import sys
from pathlib import Path

from acsard.core.messages.signature import MAX_NAME
from acsard.host.processes import called


def own_name() -> str:
    """Return a name like `alice@laptop patrol`: user, machine, and the program if it has a name."""
    try:
        user = pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        user = str(os.getuid())
    machine = os.uname().nodename.partition(".")[0]
    path = Path(sys.argv[0])
    program = path.parent.name if path.stem == "__main__" else path.stem
    return f"{user}@{machine} {program.removeprefix('-c')}".rstrip()


def sender_id(name: str, secret: str = "") -> str:
    """Return a sender id `NAME/SECRET`. If `secret` is "", the id gets a new secret."""
    return f"{name[:MAX_NAME]}/{secret or new_secret()}"


def new_secret() -> str:
    """Return 128 random bits as 22 characters, none of which is "/"."""
    return secrets.token_urlsafe(16)


def own_addresses() -> list[str]:
    """Return the addresses at which others can reach this machine.

    Loopback and link-local addresses are left out. The list is empty if the command `ip` is
    missing.
    """
    try:
        found = json.loads(called(("ip", "-json", "address"), 5.0).stdout or "[]")
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return []
    told = [one["local"] for link in found for one in link.get("addr_info", ()) if "local" in one]
    real = (ipaddress.ip_address(text) for text in told)
    return [str(ip) for ip in real if not (ip.is_loopback or ip.is_link_local)]
