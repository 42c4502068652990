"""The directory of recordings: names, permissions, and which files go."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import pytest

from acsard.core.config.settings import RecordConfig
from acsard.core.values import NS_PER_S
from acsard.recording import directory
from acsard.recording.directory import RecordingDirectory
from acsard.recording.file import SUFFIX, listed

NOW_NS = 1_795_935_600 * NS_PER_S


def new(where: Path, megabytes: float = 10.0) -> RecordingDirectory:
    return RecordingDirectory(RecordConfig(str(where), megabytes))


def record(store: RecordingDirectory, wall_ns: int = NOW_NS, size: int = 0) -> Path:
    with store.begin(wall_ns) as file:
        file.write(bytes(size))
        return Path(file.name)


def modes(where: Path) -> list[str]:
    """Return the modes of the directory and of its files, in octal."""
    return [oct(path.stat().st_mode & 0o777)[2:] for path in (where, *listed(where))]


def numbers(where: Path) -> list[int]:
    return [int(path.name[:6]) for path in listed(where)]


def test_file_numbers_increase_whatever_the_clock_shows(tmp_path: Path) -> None:
    for wall_ns in (NOW_NS, 0, NOW_NS - 86_400 * NS_PER_S):
        record(new(tmp_path), wall_ns)
    assert numbers(tmp_path) == [1, 2, 3]
    assert listed(tmp_path)[1].name == f"000002-19700101T000000Z{SUFFIX}"


@pytest.mark.parametrize(
    ("service", "private", "umask", "wanted"),
    [
        (".", "elsewhere", 0, ["750", "640"]),
        (".", "elsewhere", 0o077, ["750", "640"]),
        # Every user may read the directory of a service that only root can enter.
        ("b", ".", 0o077, ["755", "644"]),
        (".", ".", 0, ["750", "640"]),  # it is another directory
        ("b", "elsewhere", 0, ["750", "640"]),  # everybody gets there, not only root
    ],
)
def test_the_group_or_every_user_may_read_a_recording(
    service: str, private: str, umask: int, wanted: list[str],
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setenv("ACSARD_RECORD", str(tmp_path / service))
    monkeypatch.setattr(directory, "PRIVATE_STATE", tmp_path / private)
    before = os.umask(umask)
    try:
        record(new(tmp_path / "b"))
    finally:
        os.umask(before)
    assert modes(tmp_path / "b") == wanted


class Disk(NamedTuple):
    f_blocks: int
    f_bavail: int
    f_frsize: int = 512


@pytest.mark.parametrize(
    ("files", "each_mb", "limit_mb", "total_mb", "free_mb", "kept", "reported"),
    [
        (12, 1, 10, 1e6, 1e6, 9, False),  # so that one more fits
        # 60 + 40 - 50 for other programs, and 20 for the next file
        (60, 1, 1000, 1000, 40, 30, True),
        # Others fill the disk: the smallest limit, less the next file.
        (30, 1, 10, 1000, 0, 9, True),
        (1, 1, 10, 0, 0, 1, False),  # a disk that does not report its size has room
        (1, 20, 10, 1e6, 1e6, 1, False),  # the newest file stays
        (1, 20, 1000, 1000, 0, 1, False),  # also on a full disk
    ],
)
def test_the_oldest_files_go_and_leave_room(
    files: int, each_mb: int, limit_mb: float, total_mb: float, free_mb: float, kept: int,
    reported: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    disk = Disk(int(total_mb * 1e6) // 512, int(free_mb * 1e6) // 512)
    monkeypatch.setattr(os, "statvfs", lambda _: disk)
    store = new(tmp_path, limit_mb)
    for _ in range(files):
        record(store, size=each_mb * 1_000_000)
    (tmp_path / "000000-notes.txt").write_bytes(bytes(5_000_000))
    text = store.make_room()
    assert numbers(tmp_path) == [*range(files - kept + 1, files + 1)]
    assert (tmp_path / "000000-notes.txt").exists()
    assert bool(text) == reported
    if files == 60:
        assert "30 recordings deleted (000001-" in text
        assert "only 40.0 MB of the disk were free, and recordings leave 50.0 MB" in text
