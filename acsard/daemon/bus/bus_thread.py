"""A thread of the bus that leaves its exception for the control loop, so that the daemon ends too.

Without the thread, the daemon would drive the robot, but no longer publish or answer.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread


class BusThread(Thread):
    """A thread of the bus, which appends an exception that ends it to `errors`.

    All of them share the list, so a control step checks only one.
    """

    def __init__(self, name: str, work: Callable[[], None], errors: list[BaseException]) -> None:
        super().__init__(name=name, daemon=True)
        self._work, self._errors = work, errors

    def run(self) -> None:
        try:
            self._work()
        except BaseException as error:  # noqa: BLE001 - the control loop raises it again
            self._errors.append(error)
