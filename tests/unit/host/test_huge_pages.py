"""Tests of the move to huge pages: its choice of areas, and that it changes no byte."""

from __future__ import annotations

import mmap
import random
from pathlib import Path

import pytest

from acsard.host import huge_pages

KB = 1024

AREAS = """\
55d0c0000000-55d0c0600000 rw-p 00000000 00:00 0                          [heap]
Size:               6144 kB
Rss:                6000 kB
VmFlags: rd wr mr mw me ac
7f0000000000-7f0000800000 rw-p 00000000 00:00 0 {space}
Size:               8192 kB
Rss:                  96 kB
7f1000000000-7f1000200000 rw-p 00000000 00:00 0 {space}
Size:               2048 kB
Rss:                2048 kB
7f2000000000-7f2000400000 rw-p 00001000 fd:00 1234                       /usr/lib/libpython3.11.so
Size:               4096 kB
Rss:                4096 kB
7f3000000000-7f3000400000 r-xp 00000000 00:00 0 {space}
Size:               4096 kB
Rss:                4096 kB
7f4000000000-7f4000021000 rw-p 00000000 00:00 0                          [stack]
Size:                132 kB
Rss:                 132 kB
""".format(space="")


def huge_kb() -> int:
    rollup = Path("/proc/self/smaps_rollup").read_text()
    return int(rollup.partition("AnonHugePages:")[2].split()[0])


def test_only_full_private_areas_without_a_file_are_chosen() -> None:
    assert list(huge_pages.filled(AREAS)) == [
        (0x55D0C0000000, 0x55D0C0600000),
        (0x7F1000000000, 0x7F1000200000),
    ]


def test_the_move_keeps_every_byte() -> None:
    with mmap.mmap(-1, 8 * KB * KB, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as area:
        written = random.Random(1).randbytes(len(area))
        area[:] = written
        before = huge_kb()
        moved = huge_pages.gather()
        assert area[:] == written
        if moved:
            assert huge_kb() - before >= 4 * KB


def test_nothing_moves_where_the_kernel_has_no_huge_pages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(huge_pages, "_SIZE", tmp_path / "none")
    assert huge_pages.gather() == 0
