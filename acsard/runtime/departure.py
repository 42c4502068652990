"""The way down: signals begin it, a second one cuts the ramp."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable

from acsard.host import clock
from acsard.host.logs import Log
from acsard.host.systemd import Systemd
from acsard.values import NS_PER_S

EXIT_RAMP_S = 0.6
"""Bound on the ramp to zero on the way down; then STOP whatever the speed."""


class Departure:
    """Signals -> the way down: the first begins it, a second cuts the ramp."""

    def __init__(self, log: Log, wake: Callable[[], None], manager: Systemd) -> None:
        self._log, self._wake, self._manager = log, wake, manager
        self._starting = asyncio.current_task()
        self.begun_ns: int | None = None
        self.hurried = False

    def watch(self) -> None:
        """Take over the signals; those of a closed terminal must not leave the wheels turning."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
            loop.add_signal_handler(number, self._signal, number)

    def started(self) -> None:
        """From now on there is a robot to ramp down; until now a signal just ended the start."""
        self._starting = None

    def _signal(self, number: signal.Signals) -> None:
        self.hurried = self.begun_ns is not None
        if self.begun_ns is None:
            self.begun_ns = clock.now().mono_ns
            self._manager.stopping()
        self._log.info("signal", signal=number.name, hurried=self.hurried)
        if self._starting is not None:
            self._starting.cancel()
        self._wake()

    def over(self, now_ns: int, at_rest: bool) -> bool:
        """The ramp has ended, been cut, or had its time."""
        if self.begun_ns is None:
            return False
        return at_rest or self.hurried or now_ns - self.begun_ns > EXIT_RAMP_S * NS_PER_S
