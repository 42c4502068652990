"""The board's end of a serial line that is a pty. A host opens the other end by its path."""

from __future__ import annotations

import errno
import os
import pty
import tty

from acsard.serial.device import unlock


class PtyEnd:
    """The pty's end of the board.

    It never blocks, and `fileno` is readable when the host has written.
    """

    def __init__(self) -> None:
        self._master, self.slave = pty.openpty()
        # Keep the slave open, or the master would see a hang-up whenever no host is connected.
        tty.setraw(self.slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self.slave)

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return self._master

    def read(self) -> bytes:
        """Return the bytes that the host has written, b"" if none."""
        try:
            data = os.read(self._master, 4096)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EIO):
                return b""
            raise
        # A killed host leaves its exclusive mark on the pty. A real port would not keep it.
        unlock(self.slave)
        return data

    def write(self, data: bytes) -> bool:
        """Write to the host; return False if nobody reads. A real wire would lose the bytes too."""
        try:
            os.write(self._master, data)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Close both ends, as if the device were unplugged."""
        os.close(self._master)
        os.close(self.slave)
