"""The serial device itself: opened raw and locked, drained, closed; refusals in words.

What lives here: system calls on a device and what their errors mean for a person. What must not:
when to open, reopen or send (`port.py` for the daemon, `blocking.py` for the tools).
"""

from __future__ import annotations

import array
import errno
import fcntl
import os
import stat
import termios
import threading
from collections.abc import Iterator
from contextlib import suppress

import serial

from acsard.host import clock
from acsard.host.errors import InUseError, MendableError, NoPortError, NotPermittedError
from acsard.host.exits import Exit, ExitError
from acsard.host.processes import holder_of

_left_open: list[int] = []
"""Descriptors that could not be closed because no thread could be started."""

DRAIN_STEP_S = 0.001
"""Between two looks at what has not left yet: a tenth of a line's time."""


class _Device(serial.Serial):  # type: ignore[misc]
    """A port that is read when it has something to read, and does not ask once more whether."""

    def read(self, size: int = 1) -> bytes:
        """What is there, at most `size` bytes; raises `SerialException` when lost or closed."""
        if self.fd is None:
            raise serial.PortNotOpenError
        try:
            data = os.read(self.fd, size)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise serial.SerialException(f"read failed: {error}") from error
        if not data:
            raise serial.SerialException("the device has hung up")
        return data


def open_raw(path: str, baud_rate: int) -> serial.Serial:
    """The port opened, locked for us alone, raw, flushed; raises OSError."""
    with suppress(IndexError):  # two threads may empty the list at the same time
        while True:
            _end(_left_open.pop())
    # With a time between bytes the driver is told to wait for one (VMIN = 1), so that a read which
    # finds nothing is refused (EAGAIN), and one of nothing is a hang-up and nothing else.
    device = _Device(
        baudrate=baud_rate, timeout=0, write_timeout=0, inter_byte_timeout=0, exclusive=True
    )
    device.port = path
    try:
        device.open()
        _set_up(device)
    except (OSError, termios.error) as error:
        if device.is_open:
            unlock(device.fileno())
        device.close()
        # A device that vanishes, or is no tty, is a `termios.error`: that is no OSError, and
        # pyserial passes it on as it is or in words only.
        hidden = error.__context__
        known = hidden if isinstance(hidden, termios.error) else error
        raise OSError(*known.args) from error
    return device


def _set_up(device: serial.Serial) -> None:
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


def unsent(fd: int) -> int:
    """Bytes the driver has not sent yet; 0 where it cannot say (a pty)."""
    waiting = array.array("i", [0])
    try:
        fcntl.ioctl(fd, termios.TIOCOUTQ, waiting)
    except OSError:
        return 0
    return waiting[0]


def draining(fd: int, deadline_ns: int) -> Iterator[float]:
    """The pauses to make, s, until all bytes have left or the time is over."""
    while unsent(fd) and clock.mono_ns() < deadline_ns:
        yield DRAIN_STEP_S


def unlock(fd: int) -> None:
    """Let others open it: a pty outlives us with our mark, and nobody else could."""
    try:
        fcntl.ioctl(fd, termios.TIOCNXCL)
    except OSError:
        pass  # the device is gone


def close(device: serial.Serial, *, lost: bool = False, wait_s: float = 0.0) -> None:
    """Throw away what is stuck, unlock, close in a thread: a driver may drain for 30 s first.

    `device` is left with /dev/null, which its owner may drain and close in no time. Wait up to
    `wait_s` for the thread. If no thread can be started, the next `open_raw` closes the device.
    """
    fd = device.fileno()
    if lost or unsent(fd):
        # Only what is stuck: on a pty a flush throws away a STOP that is already through.
        try:
            device.reset_output_buffer()
        except (OSError, termios.error):
            pass  # the device is gone, and with it what was queued
    real, null = os.dup(fd), os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
    os.dup2(null, fd, inheritable=False)
    os.close(null)
    thread = threading.Thread(target=_end, args=(real,), name="close port", daemon=True)
    try:
        thread.start()
    except RuntimeError:
        _left_open.append(real)
        return
    thread.join(wait_s)


def _end(fd: int) -> None:
    unlock(fd)
    os.close(fd)


def refusal(path: str, error: OSError) -> MendableError:
    """Why the port cannot be opened: how a one-shot tool ends; the daemon may wait instead."""
    match error.errno:
        case errno.ENOENT | errno.ENODEV | errno.ENXIO | errno.ENOTDIR:
            return NoPortError(f"{path} is not there; plug it in, or name another ({_LISTED})")
        case errno.ENOTTY | errno.EISDIR:
            return NoPortError(f"{path} is not a serial port; name another ({_LISTED})")
        case errno.EACCES | errno.EPERM:
            return NotPermittedError(f"no permission to open {path}; {_JOIN}")
        case errno.EBUSY | errno.EAGAIN:
            holder = holder_of(path)
            who = f"process {holder.pid}" if holder else "another process"
            return InUseError(f"{path} is in use by {who}; {_FREE}")
        case _:
            return ExitError(Exit.FAILURE, f"cannot open {path}: {error}")


_LISTED = "`acsard ports` lists what there is"
_FREE = "stop it first (`systemctl stop acsard` if that is it)"
_JOIN = (
    "add the user to the device's group (`sudo usermod -aG dialout $USER`, then log in again; a "
    "service has dialout already: is the device in another group, or of a kind its unit does not "
    "allow?)"
)


def require(path: str) -> None:
    """Raises `refusal` when it is no device: a daemon waits for its port, a tool must not."""
    try:
        if not stat.S_ISCHR(os.stat(path).st_mode):
            raise OSError(errno.ENOTTY, "no character device")
    except OSError as error:
        raise refusal(path, error) from None
