"""The fake MCU behind a real pty, paced by the real clock, so that the real serial code is used.

A pty carries any baud rate; here a host that sets another one than the MCU's gets garbage, and so
does the MCU, as on a real wire.
"""

from __future__ import annotations

import asyncio
import errno
import os
import pty
import termios
import tty
from types import TracebackType
from typing import get_args

from acsard.config.settings import Baud
from acsard.host import clock
from acsard.host.timerfd import TimerFd
from acsard.serial.device import unlock
from acsard.sim.fake_mcu import FakeMcu
from acsard.sim.garble import garbled

_RATES: dict[int, int] = {getattr(termios, f"B{rate}"): rate for rate in get_args(Baud)}


class SimPty:
    """Enter it to get a serial device at `path` with the fake MCU at its other end."""

    def __init__(self, mcu: FakeMcu) -> None:
        self.mcu = mcu
        self.path = ""
        self._master = self._slave = -1
        self._timer = TimerFd()

    def __enter__(self) -> SimPty:
        self._master, self._slave = pty.openpty()
        # Held open here, or the master would see a hang-up whenever no host is connected.
        tty.setraw(self._slave)
        self._set_speed()
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        loop = asyncio.get_running_loop()
        loop.add_reader(self._master, self._read)
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
        loop.remove_reader(self._master)
        loop.remove_reader(self._timer.fileno())
        self._timer.close()
        os.close(self._master)
        os.close(self._slave)

    def _read(self) -> None:
        try:
            data = os.read(self._master, 4096)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EIO):
                return
            raise
        # A host that was killed leaves its exclusive mark on the pty, as no real port would.
        unlock(self._slave)
        self.mcu.receive(clock.now().mono_ns, garbled(data, self._speed(), self.mcu.baud_rate))
        self._arm()

    def _set_speed(self) -> None:
        """The MCU's own rate, for a host that sets none."""
        attributes = termios.tcgetattr(self._slave)
        attributes[4] = attributes[5] = getattr(termios, f"B{self.mcu.baud_rate}")
        termios.tcsetattr(self._slave, termios.TCSANOW, attributes)

    def _speed(self) -> int:
        """The host's rate; the MCU's own where it is one no MCU has."""
        return _RATES.get(termios.tcgetattr(self._slave)[5], self.mcu.baud_rate)

    def _advance(self) -> None:
        self._timer.expirations()
        data = self.mcu.advance(clock.now().mono_ns)
        if data:
            try:
                os.write(self._master, garbled(data, self.mcu.baud_rate, self._speed()))
            except BlockingIOError:
                pass  # nobody reads; a real wire would lose the bytes too
        self._arm()

    def _arm(self) -> None:
        due_ns = self.mcu.next_ns()
        if due_ns is not None:
            self._timer.set(due_ns)
