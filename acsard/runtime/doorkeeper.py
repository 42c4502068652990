"""Keeps the door to the network, a fleet's router or the page open: a process of its own each.

It says all the time that it is alive; one that does not (stopped, or hung as a whole) is ended. As
a service the door is a unit of its own (`acsard-door.service`), where systemd does that, with
limits that only it can set.
"""

from __future__ import annotations

import asyncio
import os
import select
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence

from msgspec import Struct

from acsard.host import clock
from acsard.host.exits import Exit
from acsard.host.silence import Silence
from acsard.host.threads import in_thread
from acsard.values import NS_PER_S, Event, EventName

AGAIN_S = 0.1
"""Before a door is opened anew that had to be."""

LATER_S = 2.0
"""Before one is tried again that could not be opened."""

BEAT_S = 0.5
"""How often to look whether it has said something; it does so twice in that time."""

SILENT_NS = 3 * NS_PER_S
"""It judges itself after a second (`door/watch.py`), and waits for nobody longer than that; this is
for one that cannot even do that."""

START_NS = 15 * NS_PER_S
"""How long it may take to say something for the first time: Python's start, on a busy machine."""


class Kind(Struct, frozen=True):
    """What is kept open."""

    name: str
    ended: EventName
    final: frozenset[int] = frozenset()
    """Exit codes after which it is not tried again."""
    again_s: float = AGAIN_S
    """Before it is opened anew."""


DOOR = Kind("the door to the network", "door_ended")
"""Tried for ever: the robot drives on, and its files may be mended meanwhile."""

ROUTER = Kind("the router", "router_ended", frozenset({Exit.USAGE, Exit.BAD_CONFIG}))

PAGE = Kind(
    "the robot's page",
    "page_ended",
    frozenset({Exit.OK, Exit.USAGE, Exit.IN_USE, Exit.NO_PERMISSION, Exit.BAD_CONFIG}),
    LATER_S,
)
"""A page that fails again and again takes no time from the robot; it says itself why it ends."""


async def keep_door(words: Sequence[str], log: Callable[[Event], None], kind: Kind = DOOR) -> int:
    """`acsard` with these words ("door", ...), again whenever it ends, until cancelled.

    Returns an exit code that is final.
    """
    while True:
        door = _Door(words)
        try:
            code = await in_thread(door.run, None)
            why = door.silent or (
                f"was ended by signal {-code}" if code < 0 else f"ended with {code}"
            )
        except (OSError, RuntimeError) as error:  # no room for a process, or for a thread
            code, why = Exit.USAGE, f"could not be started ({error})"
        else:
            if code in kind.final:
                return code
        finally:
            door.let_go()
        log(Event(kind.ended, f"{kind.name} {why}; it is opened anew", "warning"))
        await asyncio.sleep(kind.again_s if code <= Exit.FAILURE else LATER_S)


class _Door:
    """One life of the process."""

    def __init__(self, words: Sequence[str]) -> None:
        # -P: what is installed, and not what lies in the directory that we were started in.
        self._command = [sys.executable, "-P", "-m", "acsard", *words, "--held"]
        self._ours: socket.socket | None = None
        self._over = False
        self.silent = ""
        """Why it was ended, if we did that."""

    def run(self) -> int:
        """Start it and wait for its end, in one thread: the process ends with its thread at last.

        Raises `OSError`.
        """
        hidden = ("NOTIFY_SOCKET", "INVOCATION_ID")
        env = {key: value for key, value in os.environ.items() if key not in hidden}
        ours, its = socket.socketpair()
        with ours:
            # A session of its own: what is typed at the terminal is for the daemon, which ends it.
            with its:
                process: subprocess.Popen[bytes] = subprocess.Popen(
                    self._command, stdin=its.fileno(), stdout=2, start_new_session=True, env=env
                )
            self._ours = ours
            if self._over:  # let go of while it was started
                self.let_go()
            if self._falls_silent(ours):
                process.kill()
            return process.wait()

    def _falls_silent(self, ours: socket.socket) -> bool:
        """Listen to it; False when it has ended, or been let go of."""
        silence, before_ns, heard = Silence(START_NS), clock.mono_ns(), False
        while True:
            said = ours.recv(4096) if select.select([ours], [], [], BEAT_S)[0] else None
            if said == b"":
                return False
            if said and not heard:
                heard, silence = True, Silence(SILENT_NS)
            now_ns = clock.mono_ns()
            if silence.too_long(bool(said), now_ns - before_ns):
                self.silent = "did not say any more that it is alive (stopped, or hung): ended"
                return True
            before_ns = now_ns

    def let_go(self) -> None:
        """End its standard input, which ends it."""
        self._over = True
        if self._ours is not None:
            try:
                self._ours.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass  # it has ended, or nobody holds it any more
