"""A thread of the bus. If an exception ends the thread, the daemon ends too.

Otherwise the robot would drive on, but would no longer publish or answer.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread


class BusThread(Thread):
    """A thread that stores the exception that has ended it. The control loop calls `check`."""

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
        """Raise the exception that has ended this thread. Do nothing if there is none."""
        if self._error is not None:
            raise self._error
