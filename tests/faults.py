"""Faults as values: a disk whose calls fail or hang as a test says, to be passed to the product."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path
from typing import Literal

from acsard.daemon.latch_file import Disk

Call = Literal["read", "write", "sync"]
HANGS = -1
"""In place of an `errno`: the call does not end before `mend`."""
FULL, BROKEN = errno.ENOSPC, errno.EIO


class FaultyDisk(Disk):
    """A disk on which each call of these kinds fails or hangs until `mend`, or until the test ends.

    `calls` has what was asked, with the path and, of a write, the content.
    """

    hang_timeout_s = 0.3
    retry_pause_s = 0.01

    def __init__(self, **faults: int) -> None:
        self.faults, self.goes = faults, threading.Event()
        self.calls: list[tuple[Call, Path, bytes]] = []

    def mend(self) -> None:
        self.faults = {}
        self.goes.set()

    def _meet(self, call: Call, path: Path, data: bytes = b"") -> None:
        self.calls.append((call, path, data))
        fault = self.faults.get(call)
        if fault == HANGS:
            assert self.goes.wait(10.0)
        elif fault:
            raise OSError(fault, os.strerror(fault))

    def read(self, path: Path) -> bytes:
        self._meet("read", path)
        return super().read(path)

    def write(self, path: Path, data: bytes) -> None:
        self._meet("write", path, data)
        super().write(path, data)

    def sync(self, path: Path) -> None:
        self._meet("sync", path)
        super().sync(path)
