"""The daemon's serial port: opens, reads and reopens the device, and sends STOP before closing it.

The transport of pyserial-asyncio reads the device and reports its loss. Opening runs in a thread
with a time limit, because drivers may block.
"""

from __future__ import annotations

import asyncio
import errno
import itertools
import os
from collections.abc import Callable

from serial_asyncio import SerialTransport, connection_for_serial

from acsard.core.link.serial_output import Offered, Port, SerialOutput
from acsard.core.values import Event, Instant, Ns, Received
from acsard.daemon.serial.device import Device, close, draining, open_raw, refusal, unsent
from acsard.host import clock
from acsard.host.clock import SuspendDetector
from acsard.host.errors import InUseError, MendableError, NotPermittedError
from acsard.host.threads import NoThreadError, in_thread

# A call of this duration counts as hung, and no other one is tried until it has returned.
OPEN_TIMEOUT_S = 5.0

# The last is repeated; the first are short, because udev soon sets a new device's group.
REOPEN_PAUSES_S = (0.05, 0.1, 0.2)

PERMISSION_TIMEOUT_S = 2.0  # for udev to grant access at the start

DRIVER_HUNG = "the driver of the serial port did not answer"

FINAL_STOP_TIMEOUT_S = 0.15  # twice a line at the lowest baud rate, plus a margin


class SerialPort(Port, asyncio.Protocol):
    """The serial port to the board, for the duration of an `async with` block.

    `keep_open` reopens it. At the end, the port sends STOP.
    """

    def __init__(
        self,
        path: str,
        baud_rate: int,
        stop: bytes,
        period_ns: Ns,
        wake: Callable[[Instant], None],
        log: Callable[[Event], None],
        asleep: SuspendDetector | None = None,
    ) -> None:
        # `stop` is zeros for all wheels. `wake` gets the time of data and of the loss of the port.
        self.is_open = False
        self._asleep = asleep or SuspendDetector()
        self.opened = 0
        self._path, self._baud_rate, self._stop = path, baud_rate, stop
        self._period_ns = period_ns
        self._wake, self._log = wake, log
        self._received: list[Received] = []
        self._output = SerialOutput(baud_rate, stop, period_ns)
        self._device: Device | None = None  # while it is open
        self._transport: SerialTransport  # the device's
        self._lost, self._ours = asyncio.Event(), asyncio.Event()
        self._ours.set()  # the port is not released
        # Devices that threads are opening: `st_dev`, `st_ino`.
        self._opening = set[tuple[int, int]]()
        self.trouble = ""

    # The control loop calls the methods below, which `Port` describes.

    def take(self, late: Instant | None = None) -> tuple[Received, ...]:
        if late is not None and self._device is not None:
            # Without the waiting bytes, the delay of the step would look like silence of the board.
            try:
                if data := self._device.read():
                    self._received.append(Received(late, data))
            except OSError as error:
                self._leave(error)
        if not self._received:
            return ()
        pieces = tuple(self._received)
        self._received.clear()
        return pieces

    def offer(self, line: bytes, now: Instant) -> Offered:
        # After a suspend of the computer, close the port instead of writing, even if the device
        # still works. `keep_open` then opens the port again, and every sender must send a zero
        # before it can move the robot.
        if self._asleep.detect():
            self._leave(OSError(errno.EIO, "this computer was suspended"))
        device = self._device
        if device is None:
            return "down"
        # Ask the driver for the unsent bytes before reading the clock, because asking takes time.
        waiting = unsent(device.fd)
        data = self._output.prepare(line, now.mono_ns, clock.mono_ns(), waiting)
        if data is None:
            return "superseded"
        # The line goes to the device, because the transport would queue bytes that the kernel does
        # not accept, and send an old line later.
        try:
            byte_count = device.write(data)
        except BlockingIOError:
            byte_count = 0
        except OSError as error:
            self._leave(error)
            return "down"
        # The wire is busy from the moment of the write, not from the start of the step.
        return self._output.record_write(line, data, byte_count, clock.mono_ns())

    @property
    def sent_ns(self) -> Ns:
        return self._output.sent_ns

    def release(self, released: bool) -> None:
        if released is not self._ours.is_set():
            return
        if not released:
            self.trouble = ""
            self._ours.set()
            return
        self._ours.clear()
        self._leave(None)
        self.trouble = ""

    # Opening and reopening.

    async def __aenter__(self) -> SerialPort:
        deadline_ns = clock.now().mono_ns + int(PERMISSION_TIMEOUT_S * 1e9)
        while True:
            try:
                await self._open()
                return self
            except OSError as error:
                refused = refusal(self._path, error)
            denied = isinstance(refused, NotPermittedError)
            if isinstance(refused, InUseError) or (denied and clock.mono_ns() > deadline_ns):
                raise refused
            if not denied:
                self._complain(refused)
                return self
            await asyncio.sleep(REOPEN_PAUSES_S[-1])

    async def keep_open(self) -> None:
        """Reopen the port whenever it is closed, until this task is cancelled."""
        while True:
            if self.is_open:
                await self._lost.wait()
            for attempt in itertools.count():
                await self._ours.wait()
                try:
                    await self._open()
                    break
                except OSError as error:
                    self._complain(refusal(self._path, error))
                    await asyncio.sleep(REOPEN_PAUSES_S[min(attempt, len(REOPEN_PAUSES_S) - 1)])

    async def _open(self) -> None:
        path, baud_rate, opening = self._path, self._baud_rate, self._opening
        at = os.stat(path)
        which = at.st_dev, at.st_ino
        if which in opening:
            raise OSError(errno.EIO, DRIVER_HUNG)
        opening.add(which)

        def open_port() -> Device:
            try:
                return open_raw(path, baud_rate)
            finally:
                opening.discard(which)

        try:
            device = await in_thread(open_port, OPEN_TIMEOUT_S, late=close)
        except NoThreadError as error:
            opening.discard(which)
            raise OSError(errno.EIO, str(error)) from None
        except TimeoutError:
            raise OSError(errno.EIO, DRIVER_HUNG) from None
        if not self._ours.is_set():
            close(device)
            device.close()
            raise OSError(errno.EBUSY, "the port was released meanwhile")
        self._lost.clear()
        self._output = SerialOutput(baud_rate, self._stop, self._period_ns)
        self._received.clear()
        loop = asyncio.get_running_loop()
        self._transport, _ = await connection_for_serial(loop, lambda: self, device)
        self._device = device
        self.is_open, self.trouble = True, ""
        self.opened += 1
        self._log(Event("port_open", f"{path} at {baud_rate} baud"))

    def _complain(self, refused: MendableError) -> None:
        text = f"{refused}; retrying"
        if not self._ours.is_set():
            return
        if text != self.trouble:
            self.trouble = text
            self._log(Event("port_waiting", text, "warning"))

    # Reading and losing the port. The transport calls the first two methods.

    def data_received(self, data: bytes) -> None:
        now = clock.now()
        self._received.append(Received(now, data))
        self._wake(now)

    def connection_lost(self, error: Exception | None) -> None:
        # One round of the event loop after the loss, or after `_leave`: the port is not open again.
        self._leave(error)

    def _leave(self, error: BaseException | None) -> None:
        # None: the daemon ends, or releases the port.
        device, self._device = self._device, None
        if device is None:
            return
        self.is_open = False
        if not self._transport.is_closing():  # it has not found the loss itself
            self._transport.abort()
        close(device, lost=error is not None)
        device.close()  # /dev/null
        if error is not None:
            self.trouble = f"the serial port {self._path} was lost ({error}); the daemon reopens it"
            self._log(Event("port_lost", self.trouble, "warning"))
        self._lost.set()
        self._wake(clock.now())

    # Closing.

    async def __aexit__(self, *_: object) -> None:
        # STOP is the last line, within `FINAL_STOP_TIMEOUT_S`, even after an exception.
        deadline_ns = clock.now().mono_ns + int(FINAL_STOP_TIMEOUT_S * 1e9)
        while self.is_open and self.offer(self._stop, clock.now()) == "superseded":
            if clock.now().mono_ns > deadline_ns:
                break
            await asyncio.sleep(0.001)
        if self._device is not None:
            for pause in draining(self._device.fd, deadline_ns):
                await asyncio.sleep(pause)
        self._leave(None)
