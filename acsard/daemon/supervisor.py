"""Supervises the TLS gateway, a fleet's router or the web page, each a process of its own.

The process sends a sign of life all the time. The supervisor ends a process that is silent, because
it was stopped or hangs, and starts it again. If the gateway is a service, systemd does this for its
own unit (`acsard-gateway.service`), with limits that only systemd can set.
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

from acsard.core.values import NS_PER_S, Event, EventName
from acsard.host import clock
from acsard.host.errors import Exit
from acsard.host.silence import Silence
from acsard.host.threads import in_thread

AGAIN_S = 0.1
"""Seconds before a process that ended is started again."""

LATER_S = 2.0
"""Seconds before a process that could not start is started again."""

BEAT_S = 0.5
"""Seconds between two looks for a sign of life. The process sends two in that time."""

SILENT_NS = 3 * NS_PER_S
"""Silence after which the process is killed. It ends itself after a second without progress
(`daemon/gateway/watch.py`); this limit is for a process that cannot even do that."""

START_NS = 15 * NS_PER_S
"""Time for the first sign of life: the start of Python on a busy machine."""


class Kind(Struct, frozen=True):
    """A kind of supervised process."""

    name: str
    ended: EventName
    final: frozenset[int] = frozenset()
    """Exit codes after which it is not started again."""
    again_s: float = AGAIN_S
    """Seconds before it is started again."""


GATEWAY = Kind("the TLS gateway", "gateway_ended")
"""The gateway is always started again: the robot drives on, and an operator may fix its files
meanwhile."""

ROUTER = Kind("the router", "router_ended", frozenset({Exit.USAGE, Exit.BAD_CONFIG}))

PAGE = Kind(
    "the robot's page",
    "page_ended",
    frozenset({Exit.OK, Exit.USAGE, Exit.IN_USE, Exit.NO_PERMISSION, Exit.BAD_CONFIG}),
    LATER_S,
)
"""A page that keeps failing must take no time from the robot. It reports itself why it ends."""


async def keep_running(
    words: Sequence[str], log: Callable[[Event], None], kind: Kind = GATEWAY
) -> int:
    """Run `acsard` with these arguments ("gateway", ...), again whenever it ends, until cancelled.

    Return an exit code after which it must not be started again.
    """
    while True:
        child = _Child(words)
        try:
            code = await in_thread(child.run, None)
            why = child.silent or (
                f"was ended by signal {-code}" if code < 0 else f"ended with {code}"
            )
        except (OSError, RuntimeError) as error:  # no room for a process or a thread
            code, why = Exit.USAGE, f"could not be started ({error})"
        else:
            if code in kind.final:
                return code
        finally:
            child.let_go()
        log(Event(kind.ended, f"{kind.name} {why}; it is opened anew", "warning"))
        await asyncio.sleep(kind.again_s if code <= Exit.FAILURE else LATER_S)


class _Child:
    """One run of the process."""

    def __init__(self, words: Sequence[str]) -> None:
        # With -P Python ignores the working directory, so it runs the installed package.
        self._command = [sys.executable, "-P", "-m", "acsard", *words, "--supervised"]
        self._ours: socket.socket | None = None
        self._over = False
        self.silent = ""
        """Why the supervisor killed the process, "" if it did not."""

    def run(self) -> int:
        """Start the process, wait for its end and return its exit code; raise `OSError`.

        All of this runs in one thread, so the thread ends together with the process.
        """
        hidden = ("NOTIFY_SOCKET", "INVOCATION_ID")
        env = {key: value for key, value in os.environ.items() if key not in hidden}
        ours, its = socket.socketpair()
        with ours:
            # The process gets a session of its own: terminal signals go to the daemon, which then
            # ends it.
            with its:
                process: subprocess.Popen[bytes] = subprocess.Popen(
                    self._command, stdin=its.fileno(), stdout=2, start_new_session=True, env=env
                )
            self._ours = ours
            if self._over:  # released while it was being started
                self.let_go()
            if self._falls_silent(ours):
                process.kill()
            return process.wait()

    def _falls_silent(self, ours: socket.socket) -> bool:
        """Wait for signs of life; return False when the process has ended or was released."""
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
        """Close the process's standard input, which makes it end."""
        self._over = True
        if self._ours is not None:
            try:
                self._ours.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass  # it has ended, or its end of the socket is closed
