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

from tests.system import bystander
from tests.system.harness import Bus, Daemon, Periods, environment, until
from tests.system.test_recording import files, replayed

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.geteuid() != 0, reason="only root may mount"),
]

SPAN_S = 5.0

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


def fill(where: Path, size: int, names: Iterator[str]) -> None:
    """Write files of this size until the disk is full. The last file may be cut."""
    with suppress(OSError):
        for name in names:
            (where / name).write_bytes(bytes(size))


@contextmanager
def records(where: Path, record: Path) -> Iterator[Daemon]:
    """Run a daemon that drives until the disk has a second of its recording, then yield it."""
    before = set(record.glob("*.rec.zst"))
    with (
        Daemon(where, words=["--record", str(record)]) as daemon,
        Bus(daemon.endpoint) as bus,
    ):
        bus.linked()
        with bus.commanding(0.3):
            until(
                lambda: any(
                    path.stat().st_size > 3000 for path in set(record.glob("*.rec.zst")) - before
                ),
                30.0,
                "it",
            )
        assert bus.state()["recording_error"] == ""
        yield daemon


def test_on_a_disk_smaller_than_the_limit_the_oldest_recordings_go(tmp_path: Path) -> None:
    with disk(tmp_path, "size=40m") as path:
        record = path / "record"
        record.mkdir()
        names = [f"{number:06}-20260101T000000Z.rec.zst" for number in range(1, 50)]
        fill(record, 1_000_000, iter(names))
        with records(tmp_path, record) as daemon:
            daemon.process.kill()
            daemon.process.wait()
        left = files(path)
        assert names[0] not in [file.name for file in left], "the oldest went"
        assert len(left) > 15, "the others stay"
        assert replayed(tmp_path, left[-1]) > 0


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
    lived_again(tmp_path, tmp_path / "record")
