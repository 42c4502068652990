"""A thread of the bus that passes its exception to the control loop, so that the daemon ends too.

If the daemon went on without the thread, it would drive the robot, but would no longer publish or
answer.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread


class BusThread(Thread):
    """A thread of the bus. If an exception ends the thread, `check` raises this exception."""

    def __init__(self, name: str, work: Callable[[], None]) -> None:
        super().__init__(name=name, daemon=True)
        self._work = work
        self._error: BaseException | None = None

    def run(self) -> None:
        try:
            self._work()
        except BaseException as error:  # noqa: BLE001 - `check` raises it again
            self._error = error

    def check(self) -> None:
        """Raise the exception that has ended this thread, if any."""
        if self._error is not None:
            raise self._error
