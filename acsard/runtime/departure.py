"""The shutdown on a signal: the first signal ramps to zero, a second one cuts the ramp short."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable

from acsard.host import clock
from acsard.host.logs import Log
from acsard.host.systemd import Systemd
from acsard.values import NS_PER_S

EXIT_RAMP_S = 0.6
"""Bound on the ramp to zero, s. After it the daemon sends STOP at any speed."""


class Departure:
    """The shutdown, begun by the first signal and hurried by the second."""

    def __init__(self, log: Log, wake: Callable[[], None], manager: Systemd) -> None:
        self._log, self._wake, self._manager = log, wake, manager
        self._starting = asyncio.current_task()
        self.begun_ns: int | None = None
        self.hurried = False

    def watch(self) -> None:
        """Handle the signals.

        Those of a closed terminal are included, because it must not leave the wheels turning.
        """
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
            loop.add_signal_handler(number, self._signal, number)

    def started(self) -> None:
        """Note that the start is complete.

        Before this a signal cancels the start; now it begins the ramp.
        """
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
        """Return whether the ramp has ended, was cut short or has taken too long."""
        if self.begun_ns is None:
            return False
        return at_rest or self.hurried or now_ns - self.begun_ns > EXIT_RAMP_S * NS_PER_S
