"""Keeps the door to the network, or a fleet's router, open: a process of its own, again and again.

As a service the door is a unit of its own (`acsard-door.service`), with limits that only systemd
can set.
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
"""Before a door is opened anew that had to be."""

LATER_S = 2.0
"""Before one is tried again that could not be opened."""


async def keep_door(
    words: Sequence[str], log: Callable[[Event], None], what: str = "the door to the network"
) -> None:
    """`acsard` with these words ("door", ...), again whenever it ends, until cancelled."""
    while True:
        door = _Door(words)
        try:
            code = await in_thread(door.run, None)
            why = f"was ended by signal {-code}" if code < 0 else f"ended with {code}"
        except (OSError, RuntimeError) as error:  # no room for a process, or for a thread
            code, why = Exit.USAGE, f"could not be started ({error})"
        finally:
            door.let_go()
        log(Event("door_ended", f"{what} {why}; it is opened anew", "warning"))
        await asyncio.sleep(AGAIN_S if code <= Exit.FAILURE else LATER_S)


class _Door:
    """One life of the process."""

    def __init__(self, words: Sequence[str]) -> None:
        # -P: what is installed, and not what lies in the directory that we were started in.
        self._command = [sys.executable, "-P", "-m", "acsard", *words, "--held"]
        self._process: subprocess.Popen[bytes] | None = None
        self._over = False

    def run(self) -> int:
        """Start it and wait for its end, in one thread: the process ends with its thread at last.

        Raises `OSError`.
        """
        hidden = ("NOTIFY_SOCKET", "INVOCATION_ID")
        env = {key: value for key, value in os.environ.items() if key not in hidden}
        # A session of its own: what is typed at the terminal is for the daemon, which ends it.
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=2, start_new_session=True, env=env
        )
        if self._over:  # let go of while it was started
            self.let_go()
        return self._process.wait()

    def let_go(self) -> None:
        """Close its standard input, which ends it."""
        self._over = True
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
