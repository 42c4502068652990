"""Keeps the door to the network open beside a daemon in the foreground: a process of its own.

As a service it is a unit of its own (`acsard-door.service`), with limits that only systemd can set.
"""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Callable, Sequence

from acsard.host.exits import Exit
from acsard.host.threads import in_thread
from acsard.values import Event

AGAIN_S = 0.1
LATER_S = 2.0
"""Before a door is opened anew: one that had to be, and one that could not be."""

MEND = {Exit.IN_USE, Exit.NO_PERMISSION, Exit.BAD_CONFIG}
"""What it says why by itself."""


async def keep_door(words: Sequence[str], log: Callable[[Event], None]) -> None:
    """`acsard door` with these words, again whenever it ends, until cancelled."""
    command = [sys.executable, "-m", "acsard", "door", "--held", *words]
    while True:
        process = await in_thread(lambda: _started(command), None, _let_go)
        try:
            code = await in_thread(process.wait, None)
        finally:
            _let_go(process)
        log(Event("door_ended", _why(code), "warning"))
        await asyncio.sleep(LATER_S if code in MEND else AGAIN_S)


def _started(command: Sequence[str]) -> subprocess.Popen[bytes]:
    # A session of its own: what is typed at the terminal is for the daemon, which ends it.
    env = {k: v for k, v in os.environ.items() if k not in ("NOTIFY_SOCKET", "INVOCATION_ID")}
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, start_new_session=True, env=env
    )


def _let_go(process: subprocess.Popen[bytes]) -> None:
    """Which ends it."""
    if process.stdin is not None:
        process.stdin.close()


def _why(code: int) -> str:
    if code < 0:
        return f"the door to the network was ended by signal {-code}; it is opened anew"
    return f"the door to the network ended with {code}; it is opened anew"
