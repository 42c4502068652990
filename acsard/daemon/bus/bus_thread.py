"""A thread of the bus whose unexpected end ends the daemon.

Without such a thread the robot would drive on, but would no longer publish or answer. An exception
in it is a bug, like one in a control step.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread


class BusThread(Thread):
    """A thread that keeps the exception that has ended it, for the control loop."""

    def __init__(self, name: str, work: Callable[[], None]) -> None:
        """Prepare the thread, which runs `work`."""
        super().__init__(name=name, daemon=True)
        self._work = work
        self._error: BaseException | None = None

    def run(self) -> None:
        try:
            self._work()
        except BaseException as error:  # noqa: BLE001 - raised again by `check`, so it ends the process
            self._error = error

    def check(self) -> None:
        """Raise the exception that has ended this thread, if there was one. Never wait."""
        if self._error is not None:
            raise self._error
