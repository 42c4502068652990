"""Blocking access to a locked serial port for `acsard mcu check`. Every wait has a time limit."""

from __future__ import annotations

import os
import select
import termios
import time

import serial

from acsard.checkup.board import Wire
from acsard.checkup.findings import WireLostError
from acsard.core.values import NS_PER_S
from acsard.daemon.serial.device import close, draining, open_raw, refusal
from acsard.host import clock
from acsard.host.processes import Holder, master_of, waited_ns

SEND_TIMEOUT_S = 0.5
"""Longest time for which `send` waits until the driver has accepted all bytes, s. After this time,
the connection counts as lost. A line needs only 50 ms, even at the lowest baud rate."""

DRAIN_TIMEOUT_S = 0.5
"""Longest time for which `close` waits until the driver has sent the last stop lines, s."""

CLOSE_TIMEOUT_S = 1.0
"""Longest time for which `close` waits until the device is closed, s. Some drivers take 30 s,
because they first try to send the bytes in their buffer."""


class BlockingPort(Wire):
    """Blocking access to one serial device. `Wire` describes its methods."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._device: serial.Serial | None = None
        self._program: Holder | None = None
        """The program at the other end of a pty, or None for a real device."""
        self._waited_ns = 0

    def open(self, baud_rate: int) -> None:
        if self._device is None:
            try:
                self._device = open_raw(self._path, baud_rate)
            except OSError as error:
                raise refusal(self._path, error) from error
            self._program = master_of(self._path)
            self.late_ns()
            return
        fd = self._device.fileno()
        try:
            attributes = termios.tcgetattr(fd)
            attributes[4] = attributes[5] = getattr(termios, f"B{baud_rate}")
            termios.tcsetattr(fd, termios.TCSADRAIN, attributes)
            termios.tcflush(fd, termios.TCIFLUSH)
        except (OSError, termios.error) as error:
            raise WireLostError(f"{self._path}: {error}") from error

    def close(self) -> None:
        device, self._device = self._device, None
        if device is None:
            return
        for pause in draining(device.fileno(), clock.mono_ns() + int(DRAIN_TIMEOUT_S * NS_PER_S)):
            time.sleep(pause)
        close(device, wait_s=CLOSE_TIMEOUT_S)
        device.close()

    def now_ns(self) -> int:
        return clock.mono_ns()

    def late_ns(self) -> int:
        if self._program is None:
            return 0
        before_ns, self._waited_ns = self._waited_ns, waited_ns(self._program.pid)
        return max(0, self._waited_ns - before_ns)

    def send(self, data: bytes) -> None:
        fd = self._fileno()
        deadline_ns = clock.mono_ns() + int(SEND_TIMEOUT_S * NS_PER_S)
        while data:
            try:
                data = data[os.write(fd, data) :]
            except BlockingIOError:
                left_s = (deadline_ns - clock.mono_ns()) / NS_PER_S
                if left_s <= 0:
                    raise WireLostError(f"{self._path} accepts no more bytes") from None
                select.select([], [fd], [], left_s)
            except OSError as error:
                raise WireLostError(f"{self._path} was lost: {error.strerror}") from error

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        fd = self._fileno()
        pieces: list[tuple[int, bytes]] = []
        while True:
            left_s = max(0.0, (until_ns - clock.mono_ns()) / NS_PER_S)
            ready, _, _ = select.select([fd], [], [], left_s)
            if not ready:
                return pieces
            try:
                data = os.read(fd, 4096)
            except BlockingIOError:
                continue
            except OSError as error:
                raise WireLostError(f"{self._path} was lost: {error.strerror}") from error
            if not data:
                raise WireLostError(f"{self._path} was unplugged")
            pieces.append((clock.mono_ns(), data))
            if left_s == 0.0:
                return pieces

    def _fileno(self) -> int:
        if self._device is None:
            raise WireLostError(f"{self._path} is closed")
        return int(self._device.fileno())
