"""Finds the names and addresses that identify this process and its machine to other programs."""

from __future__ import annotations

import os
import pwd
import sys
from base64 import urlsafe_b64encode
from pathlib import Path

from acsard.core.messages.signature import MAX_NAME_LENGTH


def own_name() -> str:
    """Return the name of this process: user, machine and program, like "alice@laptop patrol".

    A subcommand of acsard is part of it: "alice@laptop acsard calibrate".
    """
    try:
        user = pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        user = str(os.getuid())
    machine = os.uname().nodename.partition(".")[0]
    path = Path(sys.argv[0])
    program = path.parent.name if path.stem == "__main__" else path.stem.removeprefix("-c")
    words = [program, *sys.argv[1:2]] if program == "acsard" else [program]
    return " ".join([f"{user}@{machine}", *words]).rstrip()


def sender_id(name: str, secret: str = "") -> str:
    """Return a sender id `NAME/SECRET`, with a new random secret if there is none."""
    return f"{name[:MAX_NAME_LENGTH]}/{secret or new_secret()}"


def new_secret() -> str:
    """Return 128 random bits as 22 characters that do not include "/"."""
    return urlsafe_b64encode(os.urandom(16)).rstrip(b"=").decode()


def own_addresses() -> list[str]:
    """Return this machine's IP addresses that others can reach; none if the command `ip` fails."""
    # Only servers need this. A client only has a name.
    import ipaddress
    import json
    import subprocess

    from acsard.host.processes import run_command

    try:
        links = json.loads(run_command(("ip", "-json", "address"), 5.0).stdout or "[]")
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return []
    texts = [
        entry["local"] for link in links for entry in link.get("addr_info", ()) if "local" in entry
    ]
    real = (ipaddress.ip_address(text) for text in texts)
    return [str(ip) for ip in real if not (ip.is_loopback or ip.is_link_local)]
