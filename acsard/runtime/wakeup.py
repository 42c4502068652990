"""Whatever happens runs the control step, right where the event loop learns of it.

A timer that expires, bytes that come in, a command: each of their callbacks calls the step itself.
To wake a task instead would cost another round of the event loop each time.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable


class Wakeup:
    """Call it to have a step; what calls it from within a step gets one right after."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._step: Callable[[], bool] | None = None
        self._over: asyncio.Future[None] | None = None
        self._stepping = self._again = False

    def __call__(self) -> None:
        if self._stepping:
            self._again = True
        elif self._step is not None and self._over is not None and not self._over.done():
            self._run(self._step, self._over)

    def from_thread(self) -> None:
        """The same, from any thread."""
        try:
            self._loop.call_soon_threadsafe(self)
        except RuntimeError:
            pass  # the loop has closed: nobody is left to wake

    async def run(self, step: Callable[[], bool]) -> None:
        """Let `step` run until it returns True; what it raises is raised here."""
        self._over = self._loop.create_future()
        self._step = step
        try:
            await self._over
        finally:
            self._step = None

    def _run(self, step: Callable[[], bool], over: asyncio.Future[None]) -> None:
        self._stepping, self._again = True, False
        try:
            if step():
                over.set_result(None)
        except BaseException as error:  # noqa: BLE001
            # The event loop would log it and go on: a bug in a step ends the process.
            over.set_exception(error)
        finally:
            self._stepping = False
        if self._again:
            self._loop.call_soon(self)
