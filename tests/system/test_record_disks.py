"""The recorder on real disks that fail does not disturb the control loop.

The disks are full, read-only, or take 2 s for a sync. A second daemon runs next to the first one
and records nothing. Delays that both daemons have come from the machine and not from the disk. The
tests need root, because they mount disks.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from acsard.core.config.settings import RecordConfig
from acsard.recording.end_record import read_end
from acsard.recording.mcap_directory import RecordingDirectory, Run
from acsard.recording.mcap_file import About, Recording, RecordingWriter
from acsard.recording.recovery import recover
from acsard.recording.step_writer import INCIDENTS
from acsard.web.recordings import rows
from tests.system import bystander
from tests.system.harness import Bus, Daemon, Periods, environment, until
from tests.system.test_record import files, replayed

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.geteuid() != 0, reason="only root may mount"),
]

SPAN_S = 5.0

PAGE, EDGE = 4096, 50
"""Bytes that a disk allocates at once, and those left free after a recording's last chunk.
"""

RECORDINGS = Path(__file__).parents[1] / "recordings"

SLOW = """\
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <unistd.h>

int fsync(int fd)
{
    int (*sync)(int) = (int (*)(int))dlsym(RTLD_NEXT, "fsync");
    int book = open(getenv("SYNCS"), O_WRONLY | O_CREAT | O_APPEND, 0600);
    if (book >= 0 && write(book, ".", 1) == 1)
        close(book);
    sleep(2);
    return sync(fd);
}
"""
"""Each sync of a process takes 2 s, and leaves a dot in the file $SYNCS."""


@contextmanager
def disk(where: Path, *options: str) -> Iterator[Path]:
    """Mount a tmpfs at `where/disk`. Skips if mounting is not permitted."""
    path = where / "disk"
    path.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", ",".join(options), "acsard-test", str(path)]
    mounted = subprocess.run(words, capture_output=True, text=True, check=False)
    if mounted.returncode:
        pytest.skip(f"cannot mount: {mounted.stderr.strip()}")
    try:
        yield path
    finally:
        subprocess.run(["umount", "--lazy", str(path)], check=True)


@contextmanager
def both(where: Path, record: Path, **how: object) -> Iterator[tuple[Daemon, Bus, Bus]]:
    """Run a daemon that records to the bad disk, and another one that records nothing.

    Yields the first daemon, its bus, and the bus of the other daemon.
    """
    other = where / "other"
    other.mkdir()
    with (
        Daemon(where, words=["--record", str(record)], **how) as daemon,  # type: ignore[arg-type]
        Daemon(other) as plain,
        Bus(daemon.endpoint) as bus,
        Bus(plain.endpoint) as beside,
    ):
        bus.linked()
        beside.linked()
        yield daemon, bus, beside


def misses_what_the_other_misses(name: str, bus: Bus, beside: Bus) -> None:
    """Drive both robots for SPAN_S seconds.

    Check that the daemon with the bad disk misses hardly more periods than the other one. Periods
    in which the machine was busy are allowed in addition.
    """
    began, buses = time.monotonic(), (bus, beside)
    with bus.commanding(0.3), beside.commanding(0.3):
        first = [client.state() for client in buses]
        time.sleep(SPAN_S)
        last = [client.state() for client in buses]
    late = bystander.lost(began)
    bad, quiet = (Periods.between(a, b).missed for a, b in zip(first, last, strict=True))
    print(f"\n{name}: {bad} periods missed, {quiet} beside it, in {SPAN_S:g} s")
    assert bad <= quiet + 100 * late + 2  # one sync in the loop would cost 200


def says(bus: Bus, text: str) -> None:
    """Wait until `recording_error` in the `state` contains the text, or is empty for ""."""
    until(
        lambda: (error := bus.state()["recording_error"]) == text or (text and text in error),
        30.0,
        text,
    )


def lived_again(where: Path, record: Path) -> None:
    """Check that all files next to the recording replay, and together have more than 50 lines."""
    paths = files(record.parent)
    assert paths
    assert sum(replayed(where, path) for path in paths) > 50


@pytest.mark.nightly
def test_a_disk_that_is_full_is_reported_and_costs_only_records(tmp_path: Path) -> None:
    with disk(tmp_path, "size=256k") as path:
        ballast = path / "ballast"
        ballast.write_bytes(bytes(220 * 1024))
        with both(tmp_path, path / "record") as (daemon, bus, beside):
            with bus.commanding(0.3):
                says(bus, "No space left on device")
            misses_what_the_other_misses("full", bus, beside)
            says(bus, "No space left on device")
            assert any(event["level"] == "warning" for event in daemon.events("recording"))
            ballast.unlink()
            says(bus, "")
            daemon.process.terminate()
            assert daemon.ended(5.0) == 0
        lived_again(tmp_path, path / "record")


def fill(where: Path, content: bytes, names: Iterator[str]) -> None:
    """Write files with this content until the disk is full. The last file may be cut."""
    with suppress(OSError):
        for name in names:
            (where / name).write_bytes(content)
            os.utime(where / name, (0, time.time() - 3600.0))


@contextmanager
def records(where: Path, record: Path) -> Iterator[Daemon]:
    """Run a daemon that drives until the disk has a second of its recording, then yield it."""
    before = set(record.glob("*.part"))

    def sizes() -> list[int]:
        return [path.stat().st_size for path in set(record.glob("*.part")) - before]

    with (
        Daemon(where, words=["--record", str(record)]) as daemon,
        Bus(daemon.endpoint) as bus,
    ):
        bus.linked()
        with bus.commanding(0.3):
            until(lambda: any(size > 9000 for size in sizes()), 30.0, "it")
        assert bus.state()["recording_error"] == ""
        yield daemon


def test_a_ring_larger_than_its_disk_loses_the_oldest_and_records_on(tmp_path: Path) -> None:
    recorded = (RECORDINGS / "quiet.mcap").read_bytes()
    with disk(tmp_path, f"size={12 * len(recorded)}") as path:
        record = path / "record"
        record.mkdir()
        kept_name, *_ = names = ["000001-20260101T000000Z.kept.mcap"] + [
            f"{number:06}-20260101T000000Z.mcap" for number in range(2, 30)
        ]
        fill(record, recorded, iter(names))
        with records(tmp_path, record) as daemon:
            daemon.process.kill()
            daemon.process.wait()
        (cut,) = record.glob("*.part")
        lines = replayed(tmp_path, cut)
        fill(path, b"others" * 1000, (f"{number}" for number in range(10_000)))
        with records(tmp_path, record) as daemon:
            daemon.process.terminate()
            assert daemon.ended(5.0) == 0
        left = sorted(entry.name for entry in record.glob("*.mcap*"))
        assert left[0] == kept_name
        assert names[1] not in left, "the oldest went"
        whole, new = record / left[-2], record / left[-1]
        assert whole.name[:6] == cut.name[:6] < new.name[:6]
        assert replayed(tmp_path, whole) == lines
        assert replayed(tmp_path, new) > 0


def test_a_recording_that_was_cut_on_a_disk_without_room_for_its_end_keeps_every_chunk(
    tmp_path: Path,
) -> None:
    with disk(tmp_path, "size=64k") as path:
        part = path / "000001-20260101T000000Z.mcap.part"
        whole = part.with_suffix("")
        writing = RecordingWriter(part, About("acsar", "0.1.0", "3.11.0", 1, 2))
        for size in (1000, 2000):
            before = writing.size
            writing.add("steps", 2, os.urandom(size))
            writing.flush()
        more = writing.size - before - size  # than the bytes themselves
        writing.add("steps", 2, os.urandom(PAGE + (-writing.size - more - EDGE) % PAGE))
        writing.flush()
        writing.close()
        assert 0 < -part.stat().st_size % PAGE < 2 * EDGE
        fill(path, bytes(PAGE), (f"{number}" for number in range(100)))
        before_it = list(Recording(part).messages())
        assert "the disk is full" in recover(part, whole, "crash", room=False)
        assert list(Recording(whole).messages()) == before_it
        assert len(before_it) == 3
        assert [row.events for row in rows(path)] == ["cut off: no end marker"]


def test_a_lack_of_inodes_deletes_at_most_one_recording_if_that_does_not_help(
    tmp_path: Path,
) -> None:
    with disk(tmp_path, "size=1m", "nr_inodes=20") as path:
        settings = RecordConfig(str(path / "record"))
        about = About("acsar", "0.1.0", "3.11.0", 1, 2)
        run = Run()
        ring = RecordingDirectory(settings, run=run)
        recordings = [ring.end(ring.begin(about), "kept") for _ in range(4)]
        fill(path, b"", (f"{number}" for number in range(100)))
        for more in ("more", "most"):  # other writers use the space that is freed
            with pytest.raises(OSError, match="No space left on device"):
                ring.begin(about)
            ring.close()
            ring = RecordingDirectory(settings, run=run, refused=True)
            assert [recording.exists() for recording in recordings] == [False, True, True, True]
            with suppress(OSError):
                (path / more).touch()
        (path / "more").unlink()
        ring.end(ring.begin(about), "plain")
        ring.close()


@pytest.mark.nightly
def test_a_directory_that_is_read_only_is_reported_and_costs_only_records(tmp_path: Path) -> None:
    with disk(tmp_path, "size=1m", "ro") as path:
        with both(tmp_path, path / "record") as (daemon, bus, beside):
            says(bus, "Read-only file system")
            misses_what_the_other_misses("read-only", bus, beside)
            subprocess.run(["mount", "-o", "remount,rw", str(path)], check=True)
            says(bus, "")
            with bus.commanding(0.3):
                time.sleep(1.0)
            daemon.process.terminate()
            assert daemon.ended(5.0) == 0
        lived_again(tmp_path, path / "record")


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
@pytest.mark.nightly
def test_a_disk_that_syncs_for_two_seconds_costs_no_period(tmp_path: Path) -> None:
    source, library, syncs = (tmp_path / name for name in ("slow.c", "slow.so", "syncs"))
    source.write_text(SLOW)
    words = ["gcc", "-shared", "-fPIC", "-o", str(library), str(source), "-ldl"]
    subprocess.run(words, check=True)
    env = environment(LD_PRELOAD=str(library), SYNCS=str(syncs))
    with both(tmp_path, tmp_path / "record", env=env) as (daemon, bus, beside):
        until(lambda: syncs.exists(), 5.0, "a sync")
        before = syncs.stat().st_size
        misses_what_the_other_misses("2 s a sync", bus, beside)
        assert syncs.stat().st_size > before
        assert bus.state()["recording_error"] == ""
        daemon.process.terminate()
        assert daemon.ended(5.0) == 0
        happened = any(daemon.events(name) for name in INCIDENTS)
    with records(tmp_path, tmp_path / "record"):
        pass
    lived_again(tmp_path, tmp_path / "record")
    first, *_ = files(tmp_path)
    last = read_end(first)
    assert last is not None
    assert last.cut in ("", "late"), "no crash has cut it"
    assert happened or first.name.endswith("Z.mcap"), "it is kept for nothing"
