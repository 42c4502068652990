"""Tests of the directory of recordings: names, permissions, and which files go."""

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


def modes(where: Path) -> set[int]:
    return {path.stat().st_mode & 0o777 for path in listed(where)}


def test_file_numbers_increase_whatever_the_clock_shows(tmp_path: Path) -> None:
    for wall_ns in (NOW_NS, 0, NOW_NS - 86_400 * NS_PER_S):
        record(new(tmp_path), wall_ns)
    names = [path.name for path in listed(tmp_path)]
    assert [name[:6] for name in names] == ["000001", "000002", "000003"]
    assert names[1] == f"000002-19700101T000000Z{SUFFIX}"


def test_no_clock_deletes_a_recording(tmp_path: Path) -> None:
    store = new(tmp_path, 30.0)
    for year in (2026, 2106, 1970, 2250, 1999):
        path = record(store, (year - 1970) * 31_556_952 * NS_PER_S, size=5_000_000)
        os.utime(path, (0, 0))
        assert store.make_room() == ""
    assert numbers(tmp_path) == [1, 2, 3, 4, 5]
    for _ in range(2):
        record(store, size=5_000_000)
        store.make_room()
    assert numbers(tmp_path) == [3, 4, 5, 6, 7], "the order is that of the numbers"


@pytest.mark.parametrize("umask", [0, 0o077])
def test_the_service_and_its_group_may_read_the_directory(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        record(new(tmp_path / "b"))
    finally:
        os.umask(before)
    assert (tmp_path / "b").stat().st_mode & 0o777 == 0o750
    assert modes(tmp_path / "b") == {0o640}


def test_every_user_may_read_the_directory_of_a_service_that_only_root_can_enter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = tmp_path / "b"
    monkeypatch.setenv("ACSARD_RECORD", str(tmp_path))
    monkeypatch.setattr(directory, "PRIVATE_STATE", tmp_path)
    record(new(where))
    assert modes(where) == {0o640}, "it is another directory"
    monkeypatch.setenv("ACSARD_RECORD", str(where))
    monkeypatch.setattr(directory, "PRIVATE_STATE", tmp_path / "elsewhere")
    record(new(where))
    assert modes(where) == {0o640}, "everybody gets there, not only root"
    monkeypatch.setattr(directory, "PRIVATE_STATE", tmp_path)
    before = os.umask(0o077)
    try:
        path = record(new(where))
    finally:
        os.umask(before)
    assert where.stat().st_mode & 0o777 == 0o755
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.skipif(os.geteuid() != 0, reason="gives a directory away")
def test_recording_works_in_a_directory_of_another_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ACSARD_RECORD", ".")
    monkeypatch.setattr(directory, "PRIVATE_STATE", tmp_path)
    monkeypatch.chdir(tmp_path)
    tmp_path.chmod(0o777)
    child = os.fork()
    if child == 0:
        try:
            os.setresuid(65534, 65534, 65534)
            record(new(Path()))
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    assert modes(tmp_path) == {0o644}


class Disk(NamedTuple):
    f_blocks: int
    f_bavail: int
    f_frsize: int = 1


def disk(monkeypatch: pytest.MonkeyPatch, total: float, free: float) -> None:
    """Pretend a disk of this size, MB."""
    size = Disk(int(total * 1e6), int(free * 1e6))
    monkeypatch.setattr(os, "statvfs", lambda path: size)


def numbers(where: Path) -> list[int]:
    return [int(path.name[:6]) for path in listed(where)]


def test_the_oldest_files_go_first_so_that_one_more_fits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk(monkeypatch, 1e6, 1e6)
    store = new(tmp_path)
    for _ in range(12):
        record(store, size=1_000_000)
    (tmp_path / "000000-notes.txt").write_bytes(bytes(5_000_000))
    assert store.make_room() == ""
    assert numbers(tmp_path) == [4, 5, 6, 7, 8, 9, 10, 11, 12]
    assert (tmp_path / "000000-notes.txt").exists()


def test_a_nearly_full_disk_is_left_to_other_programs_and_the_newest_files_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = new(tmp_path, 1000.0)
    for _ in range(60):
        record(store, size=1_000_000)
    disk(monkeypatch, 1000.0, 40.0)
    text = store.make_room()
    assert "recordings deleted (000001-" in text
    assert "only 40.0 MB of the disk were free, and recordings leave 50.0 MB" in text
    assert numbers(tmp_path)[0] == 31  # of 60 + 40 - 50, and 20 for the next file
    disk(monkeypatch, 1000.0, 0.0)
    store = new(tmp_path, 10.0)
    store.make_room()
    assert len(numbers(tmp_path)) == 9, "10 MB, less the room for the next file"


def test_a_disk_that_does_not_report_its_size_has_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk(monkeypatch, 0, 0)
    store = new(tmp_path)
    record(store, size=1_000_000)
    assert store.make_room() == ""
    assert numbers(tmp_path) == [1]


def test_the_newest_file_stays(tmp_path: Path) -> None:
    store = new(tmp_path)
    record(store, size=20_000_000)
    store.make_room()
    assert numbers(tmp_path) == [1]


def test_a_file_that_another_process_removes_meanwhile_does_no_harm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = new(tmp_path)
    first = record(store, size=8_000_000)
    for _ in range(2):
        record(store, size=8_000_000)
    unlink = Path.unlink

    def twice(path: Path, missing_ok: bool = False) -> None:
        unlink(path)
        unlink(path)

    monkeypatch.setattr(Path, "unlink", twice)
    store.make_room()
    assert not first.exists()
