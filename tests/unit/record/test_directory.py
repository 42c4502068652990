"""A directory of recordings keeps its bounds, and what must be kept goes last."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from acsard.config.settings import RecordConfig
from acsard.record import directory
from acsard.record.directory import (
    DIRECTORY_MODE,
    KEPT,
    KEPT_FILES,
    OPEN_DIRECTORY_MODE,
    PART,
    Ring,
    listed,
)
from acsard.record.file import About, Recording

DAY_NS = 86_400_000_000_000
NOW_NS = 1_800_000_000_000_000_000


def about(wall_ns: int = NOW_NS) -> About:
    return About("acsar", "0.1.0", "3.11.0", 5, wall_ns, "")


def ring(where: Path, megabytes: float = 10.0, days: float = 14.0) -> Ring:
    return Ring(RecordConfig(str(where), megabytes, days))


def record(one: Ring, size: int = 10, keep: bool = False, days: int = 0) -> Path:
    writing = one.begin(about(NOW_NS - days * DAY_NS))
    writing.add("steps", NOW_NS, os.urandom(size))
    return one.end(writing, keep)


def sizes(where: Path) -> int:
    return sum(path.stat().st_size for path in listed(where))


def test_files_are_numbered_on_whatever_the_clock_says(tmp_path: Path) -> None:
    one = ring(tmp_path)
    for wall_ns in (NOW_NS, 0, NOW_NS - DAY_NS):
        one.end(one.begin(about(wall_ns)), keep=False)
    one.close()
    names = [path.name for path in listed(tmp_path)]
    assert [name[:6] for name in names] == ["000001", "000002", "000003"]
    assert names[1] == "000002-19700101T000000Z.mcap"
    again = ring(tmp_path)
    assert record(again).name.startswith("000004")


@pytest.mark.parametrize("umask", [0, 0o077])
def test_the_directory_is_the_services_and_its_groups(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        one = ring(tmp_path / "b")
        path = record(one)
    finally:
        os.umask(before)
    assert (tmp_path / "b").stat().st_mode & 0o777 == DIRECTORY_MODE == 0o750
    assert path.stat().st_mode & 0o777 == 0o640


def modes(where: Path) -> set[int]:
    return {path.stat().st_mode & 0o777 for path in listed(where)}


def test_the_service_s_directory_lets_in_whoever_gets_there_but_to_its_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = tmp_path / "b"
    one = ring(where)
    record(one)  # as a version did that recorded for itself alone
    cut = one.begin(about())
    cut.add("steps", NOW_NS, b"whole")
    cut.flush()
    one.close()
    assert modes(where) == {0o640}
    monkeypatch.setenv("ACSARD_RECORD", str(tmp_path))
    ring(where).close()
    assert modes(where) == {0o640}, "it is another directory"
    monkeypatch.setenv("ACSARD_RECORD", str(where))
    ring(where).close()
    assert modes(where) == {0o640}, "everybody gets there, not only root"
    monkeypatch.setattr(directory, "PRIVATE", tmp_path)
    before = os.umask(0o077)
    try:
        one = ring(where)
        record(one)
        one.begin(about())
    finally:
        os.umask(before)
    assert where.stat().st_mode & 0o777 == OPEN_DIRECTORY_MODE == 0o755
    assert (len(listed(where)), modes(where)) == (4, {0o644})
    assert not (where / ".lock").stat().st_mode & 0o007


@pytest.mark.skipif(os.geteuid() != 0, reason="gives a directory away")
def test_a_directory_that_is_somebody_else_s_is_recorded_to_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ACSARD_RECORD", ".")
    monkeypatch.setattr(directory, "PRIVATE", tmp_path)
    monkeypatch.chdir(tmp_path)
    tmp_path.chmod(0o777)
    child = os.fork()
    if child == 0:
        try:
            os.setresuid(65534, 65534, 65534)
            one = ring(Path())
            record(one)
            one.close()
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    assert modes(tmp_path) == {0o644}


def test_bytes_are_bounded_the_oldest_goes_first_and_what_is_kept_last(tmp_path: Path) -> None:
    one = ring(tmp_path)
    kept = record(one, 400_000, keep=True)
    first = record(one, 400_000)
    for _ in range(40):
        record(one, 400_000)
        one.trim(NOW_NS)
        assert sizes(tmp_path) <= 10e6
    assert kept.exists()
    assert not first.exists()
    assert len(listed(tmp_path)) > 20


def test_room_is_made_among_many_files_in_a_time_that_grows_as_they_do(tmp_path: Path) -> None:
    first = record(ring(tmp_path / "first"))

    def seconds(count: int, turn: int) -> float:
        where = tmp_path / f"{count}-{turn}"
        one = ring(where, 1e-3)
        for number in range(count):
            os.link(first, where / f"{number:06}-20270115T080000Z.mcap")
        began = time.process_time()
        one.trim(NOW_NS)
        took = time.process_time() - began
        assert listed(where) == []
        return took

    many, few = (min(seconds(count, turn) for turn in range(3)) for count in (4000, 500))
    assert many < 24 * few, "8 times as many; their square would be 64 times"


def test_only_kept_files_are_bounded_in_bytes_too(tmp_path: Path) -> None:
    one = ring(tmp_path)
    for _ in range(30):
        newest = record(one, 400_000, keep=True)
    one.trim(NOW_NS)
    assert sizes(tmp_path) <= 10e6
    assert newest.exists()


def test_of_kept_files_the_last_fifty_stay(tmp_path: Path) -> None:
    one = ring(tmp_path)
    paths = [record(one, keep=True) for _ in range(KEPT_FILES + 3)]
    one.trim(NOW_NS)
    assert [path.exists() for path in paths] == [False] * 3 + [True] * KEPT_FILES


def test_days_are_bounded_but_not_of_what_is_kept(tmp_path: Path) -> None:
    one = ring(tmp_path, days=2.0)
    old, new, kept = record(one, days=3), record(one, days=1), record(one, keep=True, days=3)
    one.trim(NOW_NS)
    assert [path.exists() for path in (old, new, kept)] == [False, True, True]


def test_what_is_being_written_and_what_is_not_ours_stays(tmp_path: Path) -> None:
    one = ring(tmp_path, days=0.01)
    (tmp_path / "notes.mcap").write_bytes(b"mine")
    (tmp_path / "notes-1.txt").write_bytes(b"mine")
    writing = one.begin(about(0))
    one.trim(NOW_NS)
    assert writing.path.exists()
    assert (tmp_path / "notes.mcap").exists()
    assert len(listed(tmp_path)) == 1


def test_a_file_becomes_a_kept_one_later(tmp_path: Path) -> None:
    one = ring(tmp_path)
    path = record(one)
    one.keep(path)
    assert [p.name for p in listed(tmp_path)] == [path.name.replace(".mcap", KEPT)]
    one.keep(path)


def test_what_a_crash_has_cut_is_made_whole_and_kept(tmp_path: Path) -> None:
    one = ring(tmp_path)
    writing = one.begin(about())
    writing.add("steps", NOW_NS, b"whole")
    writing.flush()
    with writing.path.open("ab") as file:
        file.write(b"\x06torn")
    empty = one.begin(about())
    empty.path.write_bytes(b"\x89MC")
    one.close()
    again = ring(tmp_path)
    (path,) = listed(tmp_path)
    assert path.name.endswith(KEPT)
    recording = Recording(path)
    assert [data for _, _, data in recording.messages()] == [b"whole"]
    assert recording.whole
    again.close()


def test_what_a_disk_has_cut_is_made_whole_like_any_other(tmp_path: Path) -> None:
    one = ring(tmp_path)
    writing = one.begin(about())
    writing.add("steps", NOW_NS, b"whole")
    writing.flush()
    writing.close()
    one.close()
    Ring(RecordConfig(str(tmp_path)), crashed=False)
    assert [path.name for path in listed(tmp_path)] == [writing.path.name.removesuffix(".part")]


def test_two_daemons_do_not_record_to_one_place(tmp_path: Path) -> None:
    one = ring(tmp_path)
    writing = one.begin(about())
    with pytest.raises(OSError, match="another daemon records there"):
        ring(tmp_path)
    assert writing.path.name.endswith(PART)
    assert writing.path.exists()
    one.close()
    ring(tmp_path).close()


def test_what_only_has_a_recording_s_name_is_none_of_them(tmp_path: Path) -> None:
    """A pipe would keep its reader for ever, and a link leads elsewhere."""
    whole = tmp_path / "000001-20260101T000000Z.mcap"
    whole.touch()
    os.mkfifo(tmp_path / "000002-20260101T000000Z.mcap")
    (tmp_path / "000003-20260101T000000Z.mcap").symlink_to("/etc/passwd")
    (tmp_path / "000004-20260101T000000Z.mcap").symlink_to(tmp_path / "nothing")
    (tmp_path / "000005-20260101T000000Z.mcap").mkdir()
    assert listed(tmp_path) == [whole]
