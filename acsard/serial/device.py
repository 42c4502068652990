"""The serial device itself: opened raw and locked, closed off the event loop, explained in words.

What lives here: system calls on a device and what their errors mean for a person. What must not:
when to open, reopen or send (`port.py`).
"""

from __future__ import annotations

import errno
import fcntl
import os
import termios
import threading
from pathlib import Path

import serial
import serial_asyncio


def close_elsewhere(transport: serial_asyncio.SerialTransport) -> None:
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


def in_use(path: str) -> str:
    owner = port_owner(path)
    who = f"process {owner}" if owner else "another process"
    return f"{path} is in use by {who}; stop it first (`systemctl stop acsard` if that is it)"


def no_permission(path: str) -> str:
    return (
        f"no permission to open {path}; add the user to the device's group "
        "(`sudo usermod -aG dialout $USER`, then log in again; a service has dialout already: "
        "is the device in another group, or of a kind its unit does not allow?)"
    )


def why_closed(path: str, error: OSError) -> str:
    match error.errno:
        case errno.ENOENT | errno.ENODEV | errno.ENXIO:
            return f"{path} is not there; plug it in or correct mcu.port; waiting for it"
        case errno.EACCES | errno.EPERM:
            return no_permission(path) + "; retrying"
        case errno.EBUSY | errno.EAGAIN:
            return in_use(path) + "; retrying"
        case errno.ENOTTY | errno.EISDIR:
            return f"{path} is not a serial device; correct mcu.port"
        case _:
            return f"cannot open {path}: {error}; retrying"
