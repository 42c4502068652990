"""System calls that open the serial device raw and locked, drain it and close it, with advice."""

from __future__ import annotations

import array
import errno
import fcntl
import os
import struct
import termios
import threading
from collections.abc import Iterator
from contextlib import suppress

import serial
from serial.serialposix import BOTHER, TCGETS2, TCSETS2

from acsard.core.codes import reason
from acsard.core.values import Ns
from acsard.host import clock
from acsard.host.errors import InUseError, MendableError, NoPortError, NotPermittedError
from acsard.host.port_access import GETTY, console_advice, denial
from acsard.host.processes import Holder, holder_of, is_check_here
from acsard.host.threads import NoThreadError, begin

_unclosed: list[int] = []  # descriptors that `close` had no thread for


class Device(serial.Serial):  # type: ignore[misc]
    """A serial port for an asyncio transport: each read or write is one system call.

    A read returns all bytes that the driver holds, or none. It raises `serial.SerialException` if
    the device is gone. A write returns the number of bytes that the kernel accepts now.
    """

    # The descriptor never blocks. The transport sets both timeouts, and for each one pyserial would
    # set up the open port again, which a driver may block.
    timeout = write_timeout = property(lambda self: 0.0, lambda self, seconds: None)

    def read(self, size: int = 0) -> bytes:
        # The transport asks for 1024 bytes. After a stall of 0.4 s the lines are longer than that,
        # and one step must hear all of them.
        try:
            data = os.read(self.fd, 4096)  # the size of a driver's buffer
        except BlockingIOError:
            return b""  # a late step has read them
        except OSError as error:
            raise serial.SerialException(*error.args) from error
        if not data:
            raise serial.SerialException(errno.EIO, "the serial device was disconnected")
        return data

    def write(self, data: bytes) -> int:
        return os.write(self.fd, data)

    def flush(self) -> None:
        pass  # the transport calls this when it ends, and a driver may take 30 s to drain


def open_raw(path: str, baud_rate: int) -> Device:
    """Open the port in raw mode, lock it and empty its buffers. Raises `OSError`."""
    # Close the devices that `close` could not close. Two threads may empty the list at the same
    # time.
    with suppress(IndexError):
        while True:
            _end(_unclosed.pop())
    # An inter-byte timeout makes pyserial set VMIN = 1. A read without data then fails with EAGAIN,
    # so an empty read always means a hang-up.
    device = Device(baudrate=baud_rate, inter_byte_timeout=0, exclusive=True)
    device.port = path
    try:
        device.open()
        _set_up(device)
    except (OSError, termios.error, ValueError) as error:  # ValueError: of a rate without constant
        if device.is_open:
            unlock(device.fileno())
        device.close()
        # If the device vanishes or is not a tty, the cause is a `termios.error`, which is not an
        # OSError. pyserial either raises that error unchanged, or raises an error with its text.
        hidden = error.__context__
        known = hidden if isinstance(hidden, termios.error) else error
        raise OSError(*known.args) from error
    return device


def _set_up(device: serial.Serial) -> None:
    fd = device.fileno()
    fcntl.ioctl(fd, termios.TIOCEXCL)
    attributes = termios.tcgetattr(fd)
    # pyserial leaves some input processing on. A tty that echoes would send the board's own
    # feedback back to it as commands. Closing must not drop DTR, because that resets many boards,
    # so HUPCL is off.
    attributes[0] = attributes[1] = attributes[3] = 0
    attributes[2] &= ~termios.HUPCL
    termios.tcsetattr(fd, termios.TCSANOW, attributes)
    try:
        device.set_low_latency_mode(True)
    except (OSError, ValueError, NotImplementedError):
        pass  # a pty and CDC-ACM lack this mode
    device.reset_input_buffer()
    device.reset_output_buffer()


# termios2 of the kernel: the four flags, discipline and control characters, the two speeds. It has
# any baud rate, but Python's termios has no constant for 250000.
_TERMIOS2 = struct.Struct("4I20s2I")


def baud_rate_of(fd: int) -> int:
    """Return the port's baud rate."""
    *_, baud_rate = _TERMIOS2.unpack(fcntl.ioctl(fd, TCGETS2, bytes(_TERMIOS2.size)))
    return int(baud_rate)


def set_baud_rate(fd: int, baud_rate: int) -> None:
    """Set the baud rate when the driver has sent all bytes. Raises `OSError`, `termios.error`."""
    termios.tcdrain(fd)
    iflag, oflag, cflag, lflag, rest, *_ = _TERMIOS2.unpack(
        fcntl.ioctl(fd, TCGETS2, bytes(_TERMIOS2.size))
    )
    cflag = cflag & ~termios.CBAUD | BOTHER
    fcntl.ioctl(fd, TCSETS2, _TERMIOS2.pack(iflag, oflag, cflag, lflag, rest, baud_rate, baud_rate))


def unsent(fd: int) -> int:
    """Return the number of bytes that the driver has not sent; 0 if it does not say."""
    waiting = array.array("i", [0])
    try:
        fcntl.ioctl(fd, termios.TIOCOUTQ, waiting)
    except OSError:
        return 0
    return waiting[0]


def draining(fd: int, deadline_ns: Ns) -> Iterator[float]:
    """Yield pauses in s until the driver has sent all bytes, or until `deadline_ns`."""
    while unsent(fd) and clock.mono_ns() < deadline_ns:
        yield 0.001  # shorter than the time that a line takes, even at the highest baud rate


def unlock(fd: int) -> None:
    """Unlock the device: a pty would stay locked even after this process has ended."""
    try:
        fcntl.ioctl(fd, termios.TIOCNXCL)
    except OSError:
        pass  # the device is gone


def close(device: serial.Serial, *, lost: bool = False, wait_s: float = 0.0) -> None:
    """Discard unsent bytes, unlock, and close the device in a thread, which may take 30 s.

    The descriptor of `device` then is /dev/null, so the caller closes it at once (but not if this
    process has no free descriptor). Without a thread, the next `open_raw` closes the device. `lost`
    discards the output even if the driver reports none. Waits at most `wait_s`.
    """
    fd = device.fileno()
    if lost or unsent(fd):
        # Flush only if the driver has unsent bytes. On a pty, a flush discards a STOP that the
        # other end has not read yet.
        try:
            device.reset_output_buffer()
        except (OSError, termios.error):
            pass  # the device is gone, and with it the queued bytes
    try:
        null = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return  # no descriptor is free, so the caller closes the device itself, with delay
    try:
        real = os.dup(fd)
    except OSError:
        os.close(null)
        return
    os.dup2(null, fd, inheritable=False)
    os.close(null)
    ended = threading.Event()

    def end() -> None:
        _end(real)
        ended.set()

    try:
        begin(end)
    except NoThreadError:
        _unclosed.append(real)
        return
    ended.wait(wait_s)


def _end(fd: int) -> None:
    unlock(fd)
    os.close(fd)


def refusal(path: str, error: OSError) -> MendableError:
    """Return the error that says why the port cannot be opened, and what to do."""
    match error.errno:
        case errno.ENOENT | errno.ENODEV | errno.ENXIO | errno.ENOTDIR:
            if os.path.exists(path):
                return NoPortError(f"{reason('port_orphan', path=path).text} ({_LISTED})")
            return NoPortError(
                f"{path} does not exist; plug the device in, or name another port ({_LISTED})"
            )
        case errno.ENOTTY | errno.EISDIR:
            return NoPortError(f"{path} is not a serial port; name another port ({_LISTED})")
        case errno.EACCES | errno.EPERM:
            try:
                text, mend = denial(path)
            except OSError:  # it has gone since
                return NoPortError(f"{path} does not exist any more ({_LISTED})")
            return NotPermittedError(
                f"no permission: {text}; {mend}. If the systemd service of acsard has no "
                "permission, acsard.service may not allow this type of device"
            )
        case errno.EBUSY | errno.EAGAIN:
            return in_use(path, holder_of(path))
        case _:
            return MendableError(f"cannot open {path}: {error}")


def in_use(path: str, holder: Holder | None) -> InUseError:
    """Return the error that names the process that has the port open."""
    if holder and holder.name == GETTY:
        advice = console_advice(path)
        return InUseError(f"{path} is in use by a login console ({GETTY}); {advice}")
    if holder and is_check_here(holder.pid):
        return InUseError(
            f"{path} is in use by `acsard mcu check` (process {holder.pid}): wait for its end"
        )
    owner = f"process {holder.pid} ({holder.name})" if holder else "another process"
    return InUseError(
        f"{path} is in use by {owner}; stop that process first (`systemctl stop acsard` if it is "
        "the service of acsard)"
    )


_LISTED = "`acsard ports` lists the serial ports"
