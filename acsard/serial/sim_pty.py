"""Connects the simulated board to a real pty in real time, so that the real serial code runs.

A pty carries any baud rate. Here a host that sets another rate than the board's gets garbage, and
so does the board, as on a real wire.
"""

from __future__ import annotations

import asyncio
import termios
from types import TracebackType
from typing import get_args

from acsard.config.settings import Baud
from acsard.host import clock
from acsard.host.timerfd import TimerFd
from acsard.serial.pty_end import PtyEnd
from acsard.sim.fake_mcu import FakeMcu
from acsard.sim.garble import garbled

_RATES: dict[int, int] = {getattr(termios, f"B{rate}"): rate for rate in get_args(Baud)}


class SimPty:
    """The simulated board behind a pty. Entering it creates a serial device at `path`."""

    def __init__(self, mcu: FakeMcu) -> None:
        self.mcu = mcu
        self.path = ""
        self._timer = TimerFd()

    def __enter__(self) -> SimPty:
        self._end = PtyEnd()
        self.path = self._end.path
        self._set_speed()
        loop = asyncio.get_running_loop()
        loop.add_reader(self._end.fileno(), self._read)
        loop.add_reader(self._timer.fileno(), self._advance)
        self._arm()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._end.fileno())
        loop.remove_reader(self._timer.fileno())
        self._timer.close()
        self._end.close()

    def _read(self) -> None:
        data = self._end.read()
        if data:
            now_ns = clock.now().mono_ns
            self.mcu.receive(now_ns, garbled(data, self._speed(), self.mcu.baud_rate))
            self._arm()

    def _set_speed(self) -> None:
        """Set the board's baud rate, for a host that sets none."""
        attributes = termios.tcgetattr(self._end.slave)
        attributes[4] = attributes[5] = getattr(termios, f"B{self.mcu.baud_rate}")
        termios.tcsetattr(self._end.slave, termios.TCSANOW, attributes)

    def _speed(self) -> int:
        """Return the host's baud rate, or the board's if the host's is not one of a board."""
        return _RATES.get(termios.tcgetattr(self._end.slave)[5], self.mcu.baud_rate)

    def _advance(self) -> None:
        self._timer.expirations()
        data = self.mcu.advance(clock.now().mono_ns)
        if data:
            self._end.write(garbled(data, self.mcu.baud_rate, self._speed()))
        self._arm()

    def _arm(self) -> None:
        due_ns = self.mcu.next_ns()
        if due_ns is not None:
            self._timer.set(due_ns)
