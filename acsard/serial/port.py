"""Owns the serial port: opens it, reads it, reopens it, never queues, ends with STOP.

pyserial-asyncio reads; lines are written to the descriptor directly, because its transport keeps
what the kernel does not take and we hold nothing back (invariant 3). Opening is done in a thread
with a time limit, since drivers may block.
"""

from __future__ import annotations

import asyncio
import errno
import itertools
import os
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType

import serial
import serial_asyncio

from acsard.host import clock
from acsard.host.asleep import Asleep
from acsard.host.errors import InUseError, MendableError, NotPermittedError
from acsard.host.threads import NoThreadError, in_thread
from acsard.mcu.gate import Gate, Offered
from acsard.serial.device import close, draining, open_raw, refusal, unsent
from acsard.values import Event, Instant, Received

OPEN_TIMEOUT_S = 5.0
"""A driver that takes longer has hung: while it does, only another device is opened."""

BACK_OFF_S = (0.05, 0.1, 0.2)
"""Waits between attempts to reopen; the last one repeats. udev sets groups late, hence short."""

PERMISSION_PATIENCE_S = 2.0
"""How long a start waits for udev to grant access before it gives up."""

HUNG = "the driver did not answer"

FAREWELL_S = 0.15
"""Bound on getting the last STOP out: twice a line's time on the slowest wire, and slack."""


AT_ONCE = 4096
"""Bytes read at a time: all that a driver holds."""


class SerialPort:
    """The port to the MCU. Enter it to open, `keep_open` reopens for ever, leaving sends STOP."""

    def __init__(
        self,
        path: str,
        baud_rate: int,
        stop: bytes,
        period_ns: int,
        wake: Callable[[], None],
        log: Callable[[Event], None],
        asleep: Asleep | None = None,
    ) -> None:
        self.is_open = False
        self._asleep = asleep or Asleep()
        self.opened = 0
        self._path, self._baud_rate, self._stop = path, baud_rate, stop
        self._period_ns = period_ns
        self._wake, self._log = wake, log
        self._received: list[Received] = []
        self._gate = Gate(baud_rate, stop, period_ns)
        self._transport: serial_asyncio.SerialTransport | None = None
        self._lost = asyncio.Event()
        self._fd = -1
        self._opening = set[tuple[int, int]]()
        """The devices that are being opened, in a thread each, by where the path led then."""
        self.trouble = ""
        """Why the port is closed, in words; "" while it is open."""

    # the control loop's view

    @property
    def sent_ns(self) -> int:
        """When the last line had been handed to the kernel, monotonic."""
        return self._gate.sent_ns

    def take(self, late: Instant | None = None) -> tuple[Received, ...]:
        """What was received since the last call; with the time of a step that comes late also what
        lies there: the reader's turn may come behind the step's, which would read it as silence.

        After a suspend the port is opened anew, whether the device has noticed or not: so all that
        was before it is of another session, and every commander must be neutral again.
        """
        if self._asleep.was():
            self._leave(OSError(errno.EIO, "this computer was suspended"))
        if late is not None and self._transport is not None:
            with suppress(serial.SerialException):  # lost: the reader finds out, and says so
                data = self._transport.serial.read(AT_ONCE)
                self._received += [Received(late, data)] if data else []
        if not self._received:
            return ()
        got = tuple(self._received)
        self._received.clear()
        return got

    def offer(self, line: bytes, now: Instant) -> Offered:
        """Send the line now, or say that it did not go; it is never kept."""
        if not self.is_open:
            return "down"
        waiting = unsent(self._fd)  # before the time is read: asking the driver takes some
        data = self._gate.prepare(line, now.mono_ns, clock.mono_ns(), waiting)
        if data is None:
            return "superseded"
        try:
            taken = os.write(self._fd, data)
        except BlockingIOError:
            taken = 0
        except OSError as error:
            self._leave(error)
            return "down"
        # From the moment it went, not from the start of the step that made it.
        return self._gate.took(line, data, taken, clock.mono_ns())

    # opening and reopening

    async def __aenter__(self) -> SerialPort:
        deadline_ns = clock.now().mono_ns + int(PERMISSION_PATIENCE_S * 1e9)
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
            await asyncio.sleep(BACK_OFF_S[-1])

    async def keep_open(self) -> None:
        """Reopen the port whenever it is lost, for ever."""
        while True:
            if self.is_open:
                await self._lost.wait()
            for attempt in itertools.count():
                try:
                    await self._open()
                    break
                except OSError as error:
                    self._complain(refusal(self._path, error))
                    await asyncio.sleep(BACK_OFF_S[min(attempt, len(BACK_OFF_S) - 1)])

    async def _open(self) -> None:
        path, baud_rate, opening = self._path, self._baud_rate, self._opening
        at = os.stat(path)
        which = at.st_dev, at.st_ino
        if which in opening:
            raise OSError(errno.EIO, HUNG)
        opening.add(which)

        def open_port() -> serial.Serial:
            try:
                return open_raw(path, baud_rate)
            finally:
                opening.discard(which)

        try:
            device = await in_thread(open_port, OPEN_TIMEOUT_S, late=lambda late: late.close())
        except NoThreadError as error:
            opening.discard(which)
            raise OSError(errno.EIO, str(error)) from None
        except TimeoutError:
            raise OSError(errno.EIO, HUNG) from None
        self._lost.clear()
        self._fd = device.fileno()
        self._gate = Gate(baud_rate, self._stop, self._period_ns)
        self._received.clear()
        loop = asyncio.get_running_loop()
        try:
            self._transport, _ = await serial_asyncio.connection_for_serial(
                loop, lambda: _Reader(self), device
            )
        except OSError:  # it sets the port up once more
            close(device, lost=True)
            raise
        self.is_open, self.trouble = True, ""
        self.opened += 1
        self._log(Event("port_open", f"{path} at {baud_rate} baud"))

    def _complain(self, refused: MendableError) -> None:
        """Say once why the port cannot be opened, not at every attempt."""
        text = f"{refused}; retrying"
        if text != self.trouble:
            self.trouble = text
            self._log(Event("port_waiting", text, "warning"))

    # the reader's view

    def _data(self, data: bytes) -> None:
        self._received.append(Received(clock.now(), data))
        self._wake()

    def _leave(self, error: BaseException | None) -> None:
        """Give the port up; what the kernel still holds must not go out later."""
        if not self.is_open:
            return
        self.is_open = False
        transport, self._transport = self._transport, None
        if transport is not None and transport.serial is not None:
            # The transport would drain and close on the event loop: it gets /dev/null to do it to.
            transport.pause_reading()
            close(transport.serial, lost=error is not None)
            transport.abort()
        if error is not None:
            self.trouble = f"the serial port {self._path} was lost ({error}); reopening it"
            self._log(Event("port_lost", self.trouble, "warning"))
        self._lost.set()
        self._wake()

    # the way down

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """The last line out is STOP, whatever brought us here; bounded by `FAREWELL_S`."""
        deadline_ns = clock.now().mono_ns + int(FAREWELL_S * 1e9)
        while self.is_open and self.offer(self._stop, clock.now()) == "superseded":
            if clock.now().mono_ns > deadline_ns:
                break
            await asyncio.sleep(0.001)
        for pause in draining(self._fd, deadline_ns) if self.is_open else ():
            await asyncio.sleep(pause)
        self._leave(None)


class _Reader(asyncio.Protocol):
    """Hands bytes and losses from the transport to the port it was made for."""

    def __init__(self, port: SerialPort) -> None:
        self._port = port
        self._transport: asyncio.BaseTransport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        self._port._data(data)

    def connection_lost(self, exc: Exception | None) -> None:
        # The port may have been reopened since: an old transport's end is not the new one's.
        if self._port._transport is self._transport:
            self._port._transport = None
            self._port._leave(exc or OSError(errno.EIO, "closed"))
