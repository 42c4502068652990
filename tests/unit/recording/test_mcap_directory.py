"""A directory of recordings stays within its size limits, and protected files are deleted last."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import RECORD_VARIABLE, RecordConfig
from acsard.core.values import NS_PER_S, Instant
from acsard.recording import mcap_directory as directory
from acsard.recording.end_record import read_end
from acsard.recording.mcap_directory import (
    DIRECTORY_MODE,
    KEPT_SUFFIX,
    NEAR_SUFFIX,
    OPEN_DIRECTORY_MODE,
    PART_SUFFIX,
    RecordingDirectory,
    Run,
    listed,
)
from acsard.recording.mcap_file import About, Recording, RecordingWriter
from acsard.recording.retention import (
    MAX_KEPT_FILES,
    MIN_FILE_BYTES,
    STEADY_CLOCK_NS,
    Disk,
    Kind,
)

DAY_NS = 86_400_000_000_000
NOW_NS = 1_800_000_000_000_000_000


def about(wall_ns: int = NOW_NS) -> About:
    return About("acsar", "0.1.0", "3.11.0", 5, wall_ns, "")


def ring(where: Path, megabytes: float = 10.0) -> RecordingDirectory:
    return RecordingDirectory(RecordConfig(str(where), megabytes))


def record(store: RecordingDirectory, size: int = 10, kind: Kind = "plain", days: int = 0) -> Path:
    writing = store.begin(about())
    writing.add("steps", NOW_NS, os.urandom(size))
    path = store.end(writing, kind)
    os.utime(path, ns=(0, NOW_NS - days * DAY_NS))
    return path


def later(store: RecordingDirectory) -> None:
    """Delete surplus recordings after the clock has run steadily for long enough."""
    for mono_ns in (0, STEADY_CLOCK_NS):
        now = Instant(mono_ns, NOW_NS + mono_ns)
        store.maintain(now)
    store.trim(now)


def sizes(where: Path) -> int:
    return sum(path.stat().st_size for path in listed(where))


def test_file_numbers_increase_whatever_the_clock_shows(tmp_path: Path) -> None:
    store = ring(tmp_path)
    for wall_ns in (NOW_NS, 0, NOW_NS - DAY_NS):
        store.end(store.begin(about(wall_ns)), "plain")
    store.close()
    names = [path.name for path in listed(tmp_path)]
    assert [name[:6] for name in names] == ["000001", "000002", "000003"]
    assert names[1] == "000002-19700101T000000Z.mcap"
    again = ring(tmp_path)
    assert record(again).name.startswith("000004")


@pytest.mark.parametrize("umask", [0, 0o077])
def test_the_service_and_its_group_may_read_the_directory(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        store = ring(tmp_path / "b")
        path = record(store)
    finally:
        os.umask(before)
    assert (tmp_path / "b").stat().st_mode & 0o777 == DIRECTORY_MODE == 0o750
    assert path.stat().st_mode & 0o777 == 0o640


def modes(where: Path) -> set[int]:
    return {path.stat().st_mode & 0o777 for path in listed(where)}


def test_every_user_may_read_the_directory_of_a_service_but_not_open_its_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = tmp_path / "b"
    store = ring(where)
    record(store)  # as an older version did, which had one directory for one robot
    cut = store.begin(about())
    cut.add("steps", NOW_NS, b"whole")
    cut.flush()
    store.close()
    assert modes(where) == {0o640}
    monkeypatch.setenv("ACSARD_RECORD", str(tmp_path))
    ring(where).close()
    assert modes(where) == {0o640}, "it is another directory"
    monkeypatch.setenv("ACSARD_RECORD", str(where))
    ring(where).close()
    assert modes(where) == {0o640}, "everybody gets there, not only root"
    monkeypatch.setattr(directory, "PRIVATE_STATE", tmp_path)
    before = os.umask(0o077)
    try:
        store = ring(where)
        record(store)
        store.begin(about())
    finally:
        os.umask(before)
    assert where.stat().st_mode & 0o777 == OPEN_DIRECTORY_MODE == 0o755
    assert (len(listed(where)), modes(where)) == (4, {0o644})
    assert not (where / ".lock").stat().st_mode & 0o007


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
            store = ring(Path())
            record(store)
            store.close()
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    assert modes(tmp_path) == {0o644}


@pytest.mark.slow
def test_beyond_the_limit_in_bytes_the_oldest_files_go_first_and_protected_ones_last(
    tmp_path: Path,
) -> None:
    store = ring(tmp_path)
    incident = record(store, 400_000, kind="kept")
    first = record(store, 400_000)
    for _ in range(40):
        record(store, 400_000)
        store.trim(None)
        assert sizes(tmp_path) <= 10e6
    assert incident.exists()
    assert not first.exists()
    assert len(listed(tmp_path)) > 20


@pytest.mark.slow
def test_the_time_to_make_room_is_proportional_to_the_number_of_files(tmp_path: Path) -> None:
    first = record(ring(tmp_path / "first"))

    def seconds(count: int, turn: int) -> float:
        where = tmp_path / f"{count}-{turn}"
        store = ring(where, 1e-3)
        for number in range(count):
            os.link(first, where / f"{number:06}-20270115T080000Z.mcap")
        began = time.process_time()
        store.trim(None)
        took = time.process_time() - began
        assert listed(where) == []
        return took

    many, few = (min(seconds(count, turn) for turn in range(3)) for count in (4000, 500))
    assert many < 24 * few, "8 times as many; their square would be 64 times"


@pytest.mark.slow
def test_protected_files_count_for_the_limit_in_bytes(tmp_path: Path) -> None:
    store = ring(tmp_path)
    for _ in range(30):
        newest = record(store, 400_000, kind="kept")
    store.trim(None)
    assert sizes(tmp_path) <= 10e6
    assert newest.exists()


@pytest.mark.slow
def test_old_files_go_except_the_last_fifty_with_an_incident(
    tmp_path: Path,
) -> None:
    store = ring(tmp_path)
    incidents = [record(store, kind="kept", days=15) for _ in range(MAX_KEPT_FILES + 3)]
    fresh = record(store, kind="kept", days=1)
    old, new = record(store, days=15), record(store, days=1)
    store.close()
    later(ring(tmp_path))
    assert [path.exists() for path in incidents] == [False] * 4 + [True] * (MAX_KEPT_FILES - 1)
    assert [path.exists() for path in (fresh, old, new)] == [True, False, True]


def test_no_file_of_this_run_is_too_old_and_a_clock_that_was_just_set_is_not_trusted(
    tmp_path: Path,
) -> None:
    before = ring(tmp_path)
    old = record(before, days=15)
    before.close()
    store = ring(tmp_path)
    mine = record(store, days=15)
    for mono_ns, jump_ns in ((0, 0), (STEADY_CLOCK_NS - 1, 0), (STEADY_CLOCK_NS, 400 * DAY_NS)):
        now = Instant(mono_ns, NOW_NS + mono_ns + jump_ns)
        store.maintain(now)
        store.trim(now)
        assert old.exists()
    for mono_ns in (STEADY_CLOCK_NS + 1, 2 * STEADY_CLOCK_NS + 1):
        now = Instant(mono_ns, NOW_NS + mono_ns)
        store.maintain(now)
        store.trim(now)
    assert (old.exists(), mine.exists()) == (False, True)


def test_a_jump_of_the_clock_does_not_make_earlier_files_older(tmp_path: Path) -> None:
    store = ring(tmp_path)
    mine = record(store)
    ended_ns = mine.stat().st_mtime_ns
    store.maintain(Instant(0, NOW_NS))
    store.maintain(Instant(NS_PER_S, NOW_NS + NS_PER_S + 20 * DAY_NS))
    assert mine.stat().st_mtime_ns == ended_ns + 20 * DAY_NS
    store.close()
    again = ring(tmp_path)
    for mono_ns in (0, STEADY_CLOCK_NS):
        now = Instant(mono_ns, NOW_NS + 21 * DAY_NS + mono_ns)
        again.maintain(now)
        again.trim(now)
    assert mine.exists()


def test_if_other_programs_fill_the_disk_the_oldest_files_go_and_protected_ones_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = ring(tmp_path)
    incident = record(store, 100_000, kind="kept")
    plain = [record(store, 100_000) for _ in range(10)]
    total, others = 10_000_000, 0
    real = os.statvfs(tmp_path)

    def told(_: object) -> os.statvfs_result:
        free = max(0, total - others - sizes(tmp_path)) // 1000
        return os.statvfs_result((1000, 1000, total // 1000, free, free, *real[5:]))

    monkeypatch.setattr(os, "statvfs", told)
    store.maintain(Instant(0, NOW_NS))
    assert all(path.exists() for path in plain)
    others = 8_500_000
    store.maintain(Instant(1, NOW_NS + 1))
    assert [path.exists() for path in plain] == [False] * 2 + [True] * 8
    left = []
    for _ in range(4):  # other programs repeatedly use all free space
        others = total - sizes(tmp_path)
        store.maintain(Instant(2, NOW_NS + 2))
        left.append((sum(path.exists() for path in plain), incident.exists()))
    assert left == [(3, True), (1, True), (0, True), (0, False)]


def test_the_current_file_and_files_of_other_programs_are_never_deleted(tmp_path: Path) -> None:
    store = ring(tmp_path)
    (tmp_path / "notes.mcap").write_bytes(b"mine")
    (tmp_path / "notes-1.txt").write_bytes(b"mine")
    writing = store.begin(about(0))
    store.trim(None)
    assert writing.path.exists()
    assert (tmp_path / "notes.mcap").exists()
    assert len(listed(tmp_path)) == 1


def test_a_finished_file_can_be_retained_later(tmp_path: Path) -> None:
    store = ring(tmp_path)
    path = record(store)
    store.retain(path)
    (near,) = listed(tmp_path)
    assert near.name == path.name.replace(".mcap", NEAR_SUFFIX)
    for _ in range(2):
        store.retain(near)
    assert listed(tmp_path) == [near]


def test_a_file_that_a_crash_cut_is_finished_and_protected(tmp_path: Path) -> None:
    store = ring(tmp_path)
    writing = store.begin(about())
    writing.add("steps", NOW_NS, b"whole")
    writing.flush()
    with writing.path.open("ab") as file:
        file.write(b"\x06torn")
    empty = store.begin(about())
    empty.path.write_bytes(b"\x89MC")
    store.close()
    again = ring(tmp_path)
    (path,) = listed(tmp_path)
    assert path.name.endswith(KEPT_SUFFIX)
    recording = Recording(path)
    assert [data for _, _, data in recording.messages()] == [b"whole"]
    assert recording.is_intact
    last = read_end(path)
    assert last is not None
    assert last.cut == "crash"
    again.close()


@pytest.mark.parametrize(("behind_ns", "retained"), [(0, True), (365 * DAY_NS, False)])
def test_a_crash_retains_the_minute_before_it_but_not_all_files_if_the_clock_was_behind(
    tmp_path: Path, behind_ns: int, retained: bool
) -> None:
    store = ring(tmp_path)
    for _ in range(3):
        record(store)
    writing = store.begin(about(NOW_NS - behind_ns))
    writing.add("steps", NOW_NS - behind_ns, b"whole")
    writing.flush()
    writing.close()
    os.utime(writing.path, ns=(0, NOW_NS - behind_ns))
    store.close()
    again = ring(tmp_path)
    *earlier, cut = listed(tmp_path)
    assert [path.name.endswith(NEAR_SUFFIX) for path in earlier] == [retained] * 3
    assert cut.name.endswith(KEPT_SUFFIX)
    again.close()


def test_a_file_that_a_disk_error_cut_is_finished_and_keeps_its_class(tmp_path: Path) -> None:
    store = ring(tmp_path)
    writing = store.begin(about())
    writing.add("steps", NOW_NS, b"whole")
    writing.flush()
    writing.close()
    store.close()
    RecordingDirectory(RecordConfig(str(tmp_path)), Run(cut={writing.path.name: "plain"}))
    (path,) = listed(tmp_path)
    assert path.name == writing.path.name.removesuffix(".part")
    last = read_end(path)
    assert last is not None
    assert last.cut == "disk"


def test_two_daemons_cannot_record_to_the_same_directory(tmp_path: Path) -> None:
    store = ring(tmp_path)
    writing = store.begin(about())
    with pytest.raises(OSError, match="another daemon records into this directory"):
        ring(tmp_path)
    assert writing.path.name.endswith(PART_SUFFIX)
    assert writing.path.exists()
    store.close()
    ring(tmp_path).close()


def test_a_pipe_or_a_link_with_the_name_of_a_recording_is_not_a_recording(tmp_path: Path) -> None:
    """A pipe would block its reader forever, and a link may point to any other file."""
    whole = tmp_path / "000001-20260101T000000Z.mcap"
    whole.touch()
    os.mkfifo(tmp_path / "000002-20260101T000000Z.mcap")
    (tmp_path / "000003-20260101T000000Z.mcap").symlink_to("/etc/passwd")
    (tmp_path / "000004-20260101T000000Z.mcap").symlink_to(tmp_path / "nothing")
    (tmp_path / "000005-20260101T000000Z.mcap").mkdir()
    assert listed(tmp_path) == [whole]


@pytest.mark.parametrize(
    "event",
    [
        b"",
        b'{"seconds": 1e300, "name": "stop", "text": "stopped"}',
        b'{"seconds": 1, "name": "\xff", "text": ""}',
    ],
)
def test_a_cut_file_that_this_version_cannot_read_stays_and_is_reported(
    tmp_path: Path, event: bytes
) -> None:
    """The truncated file comes from a later version, or has an event that no version writes."""
    part = tmp_path / f"000007-20270115T080000Z{PART_SUFFIX}"
    writing = RecordingWriter(part, replace(about(), format="acsard/99") if not event else about())
    writing.add("events" if event else "steps", NOW_NS, event or b"later")
    writing.flush()
    writing.close()
    before = part.read_bytes()
    store = RecordingDirectory(RecordConfig(str(tmp_path)))
    (path,) = listed(tmp_path)
    assert path.read_bytes() == before
    assert path.name.endswith(KEPT_SUFFIX)
    (message,) = store.messages
    assert path.name in message
    assert ("acsard/99" if not event else "an event that cannot be read") in message


def test_a_disk_error_does_not_keep_the_directory_locked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (where := tmp_path / "record").mkdir()
    monkeypatch.setattr(directory, "PRIVATE_STATE", tmp_path)
    monkeypatch.setenv(RECORD_VARIABLE, str(where))
    with monkeypatch.context() as failing:

        def fails(store: RecordingDirectory) -> None:
            raise OSError(5, "Input/output error")

        failing.setattr(RecordingDirectory, "_open_files", fails)
        with pytest.raises(OSError, match="Input/output error"):
            RecordingDirectory(RecordConfig(str(where)))
    assert RecordingDirectory(RecordConfig(str(where))).messages == []


def test_an_incomplete_copy_is_deleted(tmp_path: Path) -> None:
    (left := tmp_path / f".000007-20270115T080000Z{PART_SUFFIX}.new").write_bytes(b"half")
    RecordingDirectory(RecordConfig(str(tmp_path)), run=Run())
    assert not left.exists()


def test_deleted_recordings_are_reported_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = RecordingDirectory(RecordConfig(str(tmp_path), 10.0), run=(run := Run()))
    first, *_ = [record(store, MIN_FILE_BYTES) for _ in range(7)]
    monkeypatch.setattr(store, "_disk", lambda: Disk(10**9, 10**9))
    store.trim(None)
    assert run.events == []
    store.trim(None, refused=True)
    monkeypatch.setattr(store, "_disk", lambda: Disk(10**9, 49 * 10**6))
    store.trim(None)
    (refused, low) = run.events
    assert refused.text.startswith(f"1 recording deleted ({first.name}): the disk accepted no more")
    assert low.text.startswith("5 recordings deleted (000002-")
    assert "only 49.0 MB of the disk were free, and recordings leave 50.0 MB" in low.text
    assert {refused.level, low.level} == {"warning"}


def test_recordings_beyond_the_limits_are_deleted_with_an_event_that_is_not_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = RecordingDirectory(RecordConfig(str(tmp_path), 1.0), run=(run := Run()))
    monkeypatch.setattr(store, "_disk", lambda: Disk(10**9, 10**9))
    for _ in range(10):
        record(store, MIN_FILE_BYTES)
    store.trim(None)
    (event,) = run.events
    assert "exceeded record.megabytes or 14 days" in event.text
    assert event.level == "info"


def test_a_recording_that_could_not_be_deleted_does_not_count_as_freed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> None:
        raise PermissionError(str(path))

    store = ring(tmp_path)
    record(store, 2 * MIN_FILE_BYTES)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        store.trim(None, refused=True)
    store.trim(None, refused=True)
    assert not listed(tmp_path)


def test_a_file_that_another_process_removes_meanwhile_does_no_harm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file disappears after the daemon has listed it and before it opens the file.

    The test covers freeing of space, a change of the clock, and the recovery of a truncated file.
    """

    def found(where: Path) -> list[Path]:
        paths = listed(where)
        for path in removed:
            path.unlink(missing_ok=True)
        return paths

    removed = list[Path]()
    monkeypatch.setattr(directory, "listed", found)
    store = ring(tmp_path)
    first, second = record(store), record(store)
    removed = [first]
    store.trim(None)
    store.maintain(Instant(0, NOW_NS))
    removed = [second]
    store.maintain(Instant(1, NOW_NS + DAY_NS))
    third, part = record(store), store.begin(about())
    part.add("steps", NOW_NS, b"cut")
    part.flush()
    store.close()
    monkeypatch.setattr(
        RecordingDirectory, "trim", lambda *_: None
    )  # the trim would find the third file first
    removed = [third]
    again = ring(tmp_path)
    assert again.cut_ns is not None
    assert [path.name.endswith(KEPT_SUFFIX) for path in listed(tmp_path)] == [True]
