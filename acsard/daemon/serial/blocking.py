"""Blocking access to a locked serial port for `acsard mcu check`. Every wait has a time limit."""

from __future__ import annotations

import os
import select
import termios
import time

import serial

from acsard.checkup.board import Wire
from acsard.checkup.findings import WireLostError
from acsard.core.values import NS_PER_S, Ns
from acsard.daemon.serial.device import close, draining, in_use, open_raw, refusal, set_baud_rate
from acsard.host import clock
from acsard.host.processes import Holder, holders, master_of, masters_of, waited_ns

SEND_TIMEOUT_S = 0.5  # for all bytes; a line needs 50 ms at the lowest baud rate

DRAIN_TIMEOUT_S = 0.5  # for the last stop lines

CLOSE_TIMEOUT_S = 1.0  # some drivers take 30 s to close, because they send their buffer first


class BlockingPort(Wire):
    def __init__(self, path: str) -> None:
        self._path = path
        self._device: serial.Serial | None = None
        self._program: Holder | None = None  # at the other end of a pty
        self._waited_ns = 0

    def open(self, baud_rate: int) -> None:
        if self._device is None:
            try:
                self._device = open_raw(self._path, baud_rate)
            except OSError as error:
                raise refusal(self._path, error) from error
            self._program = master_of(self._path)
            self.late_ns()
            if (reader := self._reader()) is not None:
                self.close()
                raise in_use(self._path, reader)
            return
        fd = self._device.fileno()
        try:
            set_baud_rate(fd, baud_rate)
            termios.tcflush(fd, termios.TCIFLUSH)
        except (OSError, termios.error) as error:
            raise WireLostError(f"{self._path}: {error}") from error

    def _reader(self) -> Holder | None:
        # Another program that has the port open without a lock, and takes the replies. A daemon
        # that still closes the port reads no more.
        own = {os.getpid(), *(master.pid for master in masters_of(self._path))}
        others = (each for each in holders(self._path) if each.pid not in own)
        return next((each for each in others if each.name != "acsard"), None)

    def close(self) -> None:
        device, self._device = self._device, None
        if device is None:
            return
        for pause in draining(device.fileno(), clock.mono_ns() + int(DRAIN_TIMEOUT_S * NS_PER_S)):
            time.sleep(pause)
        close(device, wait_s=CLOSE_TIMEOUT_S)
        device.close()

    def now_ns(self) -> Ns:
        return clock.mono_ns()

    def late_ns(self) -> Ns:
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
                remaining_s = (deadline_ns - clock.mono_ns()) / NS_PER_S
                if remaining_s <= 0:
                    raise WireLostError(f"{self._path} accepts no more bytes") from None
                select.select([], [fd], [], remaining_s)
            except OSError as error:
                raise WireLostError(f"{self._path} was lost: {error.strerror}") from error

    def listen(self, until_ns: Ns) -> list[tuple[int, bytes]]:
        fd = self._fileno()
        pieces: list[tuple[int, bytes]] = []
        while True:
            remaining_s = max(0.0, (until_ns - clock.mono_ns()) / NS_PER_S)
            ready, _, _ = select.select([fd], [], [], remaining_s)
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
            if remaining_s == 0.0:
                return pieces

    def _fileno(self) -> int:
        if self._device is None:
            raise WireLostError(f"{self._path} is closed")
        return int(self._device.fileno())
