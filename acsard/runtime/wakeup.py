"""When a step happens: whatever happens runs it, right where the event loop learns of it.

    period   one has ended (`ticker.py`)
    bytes    the port has read something, or was lost
    retry    a line with something new may go now (`at_once.py`)
    command  the bus has what may be a command, if its line could go at once (`at_once.py`); else
             the next period has it
    stop     the bus has a stop: whatever the pace, but not every one of a flood of them
    signal   the way down begins

To wake a task instead would cost another round of the event loop each time.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from msgspec import Struct

from acsard.runtime.ticker import Alarm


class Next(Struct, frozen=True):
    """What a step leaves to wait for, beside period, bytes, stop and signal."""

    listens: bool
    """A command is worth a step of its own."""
    retry_ns: int | None
    """When to step again, monotonic; None for no need."""
    period_ended: bool = True
    """A stop may wake the loop again."""


class Wakeup:
    """Call it to have a step; what calls it from within a step gets one right after."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._step: Callable[[], Next | None] | None = None
        self._over: asyncio.Future[None] | None = None
        self._alarm = Alarm(self)
        self._stepping = self._again = False
        self._listens = self._heard = self._stop_told = False

    def __call__(self) -> None:
        if self._stepping:
            self._again = True
        elif self._step is not None and self._over is not None and not self._over.done():
            self._run(self._step, self._over)

    def command(self) -> None:
        """From any thread: the bus has something. Once until a step listens again."""
        self._heard = True
        if self._listens:
            self._listens = False
            self._from_thread()

    def stop(self) -> None:
        """From any thread: the bus has a stop."""
        if not self._stop_told:
            self._stop_told = True
            self._from_thread()

    def _from_thread(self) -> None:
        try:
            self._loop.call_soon_threadsafe(self)
        except RuntimeError:
            pass  # the loop has closed: nobody is left to wake

    async def run(self, step: Callable[[], Next | None]) -> None:
        """Let `step` run until it returns None; what it raises is raised here."""
        self._over = self._loop.create_future()
        with self._alarm:
            self._step = step
            try:
                await self._over
            finally:
                self._step = None

    def _run(self, step: Callable[[], Next | None], over: asyncio.Future[None]) -> None:
        self._stepping, self._again, self._heard = True, False, False
        try:
            then = step()
            if then is None:
                over.set_result(None)
            else:
                self._arm(then)
        except BaseException as error:  # noqa: BLE001
            # The event loop would log it and go on: a bug in a step ends the process.
            over.set_exception(error)
        finally:
            self._stepping = False
        if self._again:
            self._loop.call_soon(self)

    def _arm(self, then: Next) -> None:
        self._alarm.set(then.retry_ns)
        self._listens = then.listens
        if then.listens or then.period_ended:
            self._stop_told = False
        if then.listens and self._heard:  # while the step ran, and perhaps too late for it
            self._listens, self._again = False, True
