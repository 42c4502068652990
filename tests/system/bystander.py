"""Measure how much time other programs take from the tests: how late a minimal process wakes up.

A test asserts that the product is fast enough, but a busy machine makes everything slower. The
bystander is a process that only wakes up every 5 ms and measures its lateness. A test adds this
lateness to its time limit. On a quiet machine it is close to zero.
"""

from __future__ import annotations

import contextlib
import mmap
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

TICK_S = 0.005

ROWS = 1 << 16
"""Number of ticks that are kept: five minutes."""

ROW = struct.Struct("dd")

_LATE = f"""\
import mmap, struct, sys, time
row = struct.Struct("dd")
with open(sys.argv[1], "r+b") as file:
    book = mmap.mmap(file.fileno(), 0)
number, due = 0, time.monotonic() + {TICK_S}
while True:
    time.sleep(max(0.0, due - time.monotonic()))
    now = time.monotonic()
    row.pack_into(book, row.size * (1 + number % {ROWS}), now, now - due)
    number += 1
    row.pack_into(book, 0, number, now)
    due = now + {TICK_S}
"""


class Bystander:
    """The minimal process, which runs until `end`. `lost` returns how late it was."""

    def __init__(self) -> None:
        with tempfile.NamedTemporaryFile() as file:
            file.truncate(ROW.size * (1 + ROWS))
            self._book = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            words = [sys.executable, "-S", "-c", _LATE, file.name]
            self._process = subprocess.Popen(words, stdin=subprocess.DEVNULL)
            self.lost(time.monotonic())

    def end(self) -> None:
        self._process.kill()
        self._process.wait()

    def lost(self, since: float, to: float | None = None) -> float:
        """Return how long the bystander waited for a core between two times, in s.

        Without `to` the interval ends now.
        """
        end = time.monotonic() if to is None else to
        deadline = end + 10.0
        while (row := ROW.unpack_from(self._book))[1] < end:
            assert self._process.poll() is None, "the bystander has ended"
            assert time.monotonic() < deadline, "the bystander stands still"
            time.sleep(TICK_S)
        count, total = int(row[0]), 0.0
        for number in range(count - 1, max(0, count - ROWS), -1):
            at, late = ROW.unpack_from(self._book, ROW.size * (1 + number % ROWS))
            if at < since:
                break
            # Count only the part of a wait that lies between the two times.
            total += max(0.0, min(at, end) - max(at - late, since))
        return total


_running: list[Bystander] = []


@contextlib.contextmanager
def standing_by() -> Iterator[None]:
    """Run a bystander while the body runs. The function `lost` uses it."""
    bystander = Bystander()
    _running.append(bystander)
    try:
        yield
    finally:
        _running.remove(bystander)
        bystander.end()


def lost(since: float, to: float | None = None) -> float:
    """Return how long a process waited for a core between two times, in s.

    Without `to` the interval ends now.
    """
    return _running[-1].lost(since, to)
