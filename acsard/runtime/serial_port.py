"""Owns the serial port: opens it, reads it, reopens it, never queues, ends with STOP.

pyserial-asyncio reads; lines are written to the descriptor directly, because its transport keeps
what the kernel does not take and we hold nothing back (invariant 3). Opening is done in a thread
with a time limit, since drivers may block.
"""

from __future__ import annotations

import array
import asyncio
import errno
import fcntl
import itertools
import os
import termios
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import serial
import serial_asyncio

from acsard.mcu.wire import LineGate
from acsard.runtime import clock
from acsard.runtime.control_loop import Offered
from acsard.runtime.exits import Exit, ExitError
from acsard.runtime.threads import in_thread
from acsard.values import Event, Instant, Received

OPEN_TIMEOUT_S = 5.0
"""A driver that takes longer has hung; the next try gets a new thread."""

BACK_OFF_S = (0.05, 0.1, 0.2)
"""Waits between attempts to reopen; the last one repeats. udev sets groups late, hence short."""

PERMISSION_PATIENCE_S = 2.0
"""How long a start waits for udev to grant access before it gives up."""

FAREWELL_S = 0.15
"""Bound on getting the last STOP out: twice a line's time on the slowest wire, and slack."""


class SerialPort:
    """The port to the MCU. Enter it to open, `keep_open` reopens for ever, leaving sends STOP."""

    def __init__(
        self,
        path: str,
        baud_rate: int,
        stop: bytes,
        wake: Callable[[], None],
        log: Callable[[Event], None],
    ) -> None:
        self.is_open = False
        self.opened = 0
        self._path, self._baud_rate, self._stop = path, baud_rate, stop
        self._wake, self._log = wake, log
        self._received: list[Received] = []
        self._gate = LineGate(baud_rate)
        self._transport: serial_asyncio.SerialTransport | None = None
        self._lost = asyncio.Event()
        self._fd = -1
        self._waiting = array.array("i", [0])
        self.trouble = ""
        """Why the port is closed, in words; "" while it is open."""

    # the control loop's view

    def take(self) -> tuple[Received, ...]:
        """What was received since the last call."""
        if not self._received:
            return ()
        got = tuple(self._received)
        self._received.clear()
        return got

    def offer(self, line: bytes, now: Instant) -> Offered:
        """Send the line now, or say that it did not go; it is never kept."""
        if not self.is_open:
            return "down"
        if not self._gate.may_send(now.mono_ns, self._kernel_bytes()):
            return "superseded"
        instead = self._gate.first and line != self._stop
        data = self._gate.prefix + (self._stop if instead else line)
        try:
            taken = os.write(self._fd, data)
        except BlockingIOError:
            taken = 0
        except OSError as error:
            self._leave(error)
            return "down"
        # From the moment it went, not from the start of the step that made it.
        self._gate.note_sent(clock.now().mono_ns, len(data), taken)
        return "sent" if taken == len(data) and not instead else "superseded"

    def _kernel_bytes(self) -> int:
        """Bytes the driver has not sent yet; 0 where it cannot say (a pty)."""
        try:
            fcntl.ioctl(self._fd, termios.TIOCOUTQ, self._waiting)
        except OSError:
            return 0
        return self._waiting[0]

    # opening and reopening

    async def __aenter__(self) -> SerialPort:
        deadline_ns = clock.now().mono_ns + int(PERMISSION_PATIENCE_S * 1e9)
        while True:
            try:
                await self._open()
                return self
            except OSError as error:
                # serial.SerialException carries the errno but not OSError's subclasses.
                if error.errno in (errno.EBUSY, errno.EAGAIN):
                    raise ExitError(Exit.IN_USE, _in_use(self._path)) from error
                if error.errno not in (errno.EACCES, errno.EPERM):
                    self._complain(error)
                    return self
                if clock.now().mono_ns > deadline_ns:
                    raise ExitError(Exit.NO_PERMISSION, _no_permission(self._path)) from error
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
                    self._complain(error)
                    await asyncio.sleep(BACK_OFF_S[min(attempt, len(BACK_OFF_S) - 1)])

    async def _open(self) -> None:
        path, baud_rate = self._path, self._baud_rate

        def open_port() -> serial.Serial:
            return open_raw(path, baud_rate)

        try:
            device = await in_thread(open_port, OPEN_TIMEOUT_S, late=lambda late: late.close())
        except TimeoutError:
            raise OSError(errno.EIO, "the driver did not answer") from None
        self._lost.clear()
        self._fd = device.fileno()
        self._gate = LineGate(baud_rate)
        self._received.clear()
        loop = asyncio.get_running_loop()
        self._transport, _ = await serial_asyncio.connection_for_serial(
            loop, lambda: _Reader(self), device
        )
        self.is_open, self.trouble = True, ""
        self.opened += 1
        self._log(Event("port_open", f"{path} at {baud_rate} baud"))

    def _complain(self, error: OSError) -> None:
        """Say once why the port cannot be opened, not at every attempt."""
        text = _why(self._path, error)
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
            if error is not None or self._kernel_bytes():
                # Only what is stuck: on a pty a flush throws away a STOP that is already through.
                try:
                    transport.serial.reset_output_buffer()
                except (OSError, termios.error):
                    pass  # the device is gone, and with it what was queued
            _close_elsewhere(transport)
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
        while self.is_open and self._kernel_bytes() and clock.now().mono_ns < deadline_ns:
            await asyncio.sleep(0.001)
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


def _close_elsewhere(transport: serial_asyncio.SerialTransport) -> None:
    """End the transport, but close the device in a thread: a driver may drain for 30 s first.

    The transport itself would drain and close on the event loop, so it is given /dev/null to do
    that to.
    """
    transport.pause_reading()
    fd = transport.serial.fileno()
    device, null = os.dup(fd), os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
    os.dup2(null, fd, inheritable=False)
    os.close(null)
    transport.abort()

    def close() -> None:
        try:
            # A pty outlives us with this flag, and nobody else could open it.
            fcntl.ioctl(device, termios.TIOCNXCL)
        except OSError:
            pass  # the device is gone
        os.close(device)

    threading.Thread(target=close, name="close port", daemon=True).start()


def open_raw(path: str, baud_rate: int) -> serial.Serial:
    """The port opened, locked for us alone, raw, flushed; raises OSError."""
    device = serial.Serial(baudrate=baud_rate, timeout=0, write_timeout=0, exclusive=True)
    device.port = path
    try:
        device.open()
    except serial.SerialException as error:
        # Only a device that is no tty fails without a number.
        raise OSError(error.errno or errno.ENOTTY, str(error)) from error
    try:
        fd = device.fileno()
        fcntl.ioctl(fd, termios.TIOCEXCL)
        attributes = termios.tcgetattr(fd)
        # pyserial leaves some input processing on; a tty that echoes would command the robot with
        # its own feedback. HUPCL off: closing must not drop DTR, which resets many boards.
        attributes[0] = attributes[1] = attributes[3] = 0
        attributes[2] &= ~termios.HUPCL
        termios.tcsetattr(fd, termios.TCSANOW, attributes)
        try:
            device.set_low_latency_mode(True)
        except (OSError, ValueError, NotImplementedError):
            pass  # a pty and CDC-ACM have no such mode
        device.reset_input_buffer()
        device.reset_output_buffer()
    except (OSError, termios.error) as error:
        device.close()
        raise OSError(errno.EIO, f"cannot set up {path}: {error}") from error
    return device


def port_owner(path: str) -> int | None:
    """The process that holds the port's lock, else one that has it open, where we may see it."""
    device, found = os.path.realpath(path), None
    for entry in Path("/proc").glob("[0-9]*/fd/*"):
        process = entry.parents[1]
        try:
            if str(entry.readlink()) != device or process.name == str(os.getpid()):
                continue
            found = int(process.name)
            if "lock:" in (process / "fdinfo" / entry.name).read_text():
                return found
        except OSError:
            continue  # it has ended, or is not ours to look at
    return found


def _in_use(path: str) -> str:
    owner = port_owner(path)
    who = f"process {owner}" if owner else "another process"
    return f"{path} is in use by {who}; stop it first (`systemctl stop acsard` if that is it)"


def _no_permission(path: str) -> str:
    return (
        f"no permission to open {path}; add the user to the device's group "
        "(`sudo usermod -aG dialout $USER`, then log in again)"
    )


def _why(path: str, error: OSError) -> str:
    match error.errno:
        case errno.ENOENT | errno.ENODEV | errno.ENXIO:
            return f"{path} is not there; plug it in or correct mcu.port; waiting for it"
        case errno.EACCES | errno.EPERM:
            return _no_permission(path) + "; retrying"
        case errno.EBUSY | errno.EAGAIN:
            return _in_use(path) + "; retrying"
        case errno.ENOTTY | errno.EISDIR:
            return f"{path} is not a serial device; correct mcu.port"
        case _:
            return f"cannot open {path}: {error}; retrying"
