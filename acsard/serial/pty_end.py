"""The microcontroller's end of a serial line that is a pty; a host opens the other by its path."""

from __future__ import annotations

import errno
import os
import pty
import tty

from acsard.serial.device import unlock


class PtyEnd:
    """Never waits; `fileno` becomes readable when the host has said something."""

    def __init__(self) -> None:
        self._master, self.slave = pty.openpty()
        # Held open here, or the master would see a hang-up whenever no host is connected.
        tty.setraw(self.slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self.slave)

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return self._master

    def read(self) -> bytes:
        """What the host has said, b"" for nothing."""
        try:
            data = os.read(self._master, 4096)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EIO):
                return b""
            raise
        # A host that was killed leaves its exclusive mark on the pty, as no real port would.
        unlock(self.slave)
        return data

    def write(self, data: bytes) -> bool:
        """Say it; False when nobody reads: a real wire would lose the bytes too."""
        try:
            os.write(self._master, data)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """The device is gone."""
        os.close(self._master)
        os.close(self.slave)
