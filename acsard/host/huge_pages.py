"""Moves this process's memory to huge pages, where the kernel offers them.

A control step runs after a pause in which the processor forgets where the memory's pages are. A
step touches some hundred pages of 4 kB, and looking them up again took 9 % of the loop's time
(measured on a virtual machine beside other work). A huge page of 2 MB needs one look-up.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterator
from pathlib import Path

_SIZE = Path("/sys/kernel/mm/transparent_hugepage/hpage_pmd_size")
_AREAS = Path("/proc/self/smaps")

_COLLAPSE = 25
"""MADV_COLLAPSE of Linux 6.1 and later: moves pages at once, in no kernel thread later on."""

_AREA = re.compile(
    r"^([0-9a-f]+)-([0-9a-f]+) rw-p [0-9a-f]+ 00:00 0 *(?:\[heap\])?\n(?:.*\n)*?Rss: +(\d+) kB$",
    re.MULTILINE,
)
"""Start, end and resident size of an area that holds objects or thread stacks."""

RESIDENT = 0.5
"""Least resident share of an area. A thread's stack is nearly empty and must not fill 2 MB."""


def gather() -> int:
    """Move the present objects to huge pages; return the number of bytes moved, 0 if none can be.

    It takes about 20 ms, so call it before the first period.
    """
    try:
        size, areas = int(_SIZE.read_text()), _AREAS.read_text()
    except (OSError, ValueError):
        return 0
    madvise = ctypes.CDLL(None).madvise
    moved = 0
    for start, end in filled(areas):
        for at in range(-(-start // size) * size, end // size * size, size):
            refused = madvise(ctypes.c_void_p(at), ctypes.c_size_t(size), _COLLAPSE)
            moved += 0 if refused else size
    return moved


def filled(areas: str) -> Iterator[tuple[int, int]]:
    """Yield the start and end of each private area that is mostly resident.

    `areas` is the text of `/proc/PID/smaps`.
    """
    for match in _AREA.finditer(areas):
        start, end = int(match[1], 16), int(match[2], 16)
        if int(match[3]) * 1024 >= RESIDENT * (end - start):
            yield start, end
