"""Delays a thread by each cause of lateness that needs no special hardware.

    python -m tests.system.late_plants CAUSE TIMES

The thread uses the same diagnosis of lateness as the control loop. For each delay the program
prints a JSON line with the texts of the reported events. Most causes need root: the thread gets the
real-time priority of the service, so that other programs do not delay it.
"""

from __future__ import annotations

import json
import mmap
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from acsard.daemon import late_watch
from acsard.daemon.late_watch import LateWatch
from acsard.host import clock

LATE_S = 0.06

FILE_BYTES = 16 << 20

CGROUP = Path("/sys/fs/cgroup/cpu") / f"acsard-test-{os.getpid()}"
"""A cgroup of version 1."""

HOG = """\
import os, sys, time
os.sched_setaffinity(0, {0})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))
print(flush=True)
for line in sys.stdin:
    for _ in range(int(line)):
        end = time.monotonic() + 0.12
        while time.monotonic() < end:
            pass
        time.sleep(0.03)
"""
"""A real-time program that keeps processor 0 busy as often as a line of its input says."""


def hog() -> subprocess.Popen[bytes]:
    """Start the real-time program that `spin` controls."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOG], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    process.stdout.readline()
    return process


def spin(process: subprocess.Popen[bytes], times: int) -> None:
    """Let the real-time program keep processor 0 busy, 0.12 s each time."""
    assert process.stdin is not None
    process.stdin.write(b"%d\n" % times)
    process.stdin.flush()


def real_time() -> None:
    """Give this process the real-time priority of the service's control loop."""
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(10))


def processor() -> Callable[[], None]:
    real_time()
    os.sched_setaffinity(0, {0})
    process = hog()

    def late() -> None:
        began = time.monotonic()
        spin(process, 1)
        while time.monotonic() - began < LATE_S:
            time.sleep(0.001)

    return late


def disk() -> Callable[[], None]:
    real_time()
    file = tempfile.NamedTemporaryFile(dir=".")  # noqa: SIM115
    file.write(os.urandom(FILE_BYTES))
    os.fsync(file.fileno())
    direct, block = os.open(file.name, os.O_RDONLY | os.O_DIRECT), mmap.mmap(-1, 1 << 20)

    def late() -> None:
        began, number = time.monotonic(), 0
        while time.monotonic() - began < LATE_S:
            os.preadv(direct, [block], (number << 20) % FILE_BYTES)
            number += 1
        assert file.name

    return late


def memory() -> Callable[[], None]:
    real_time()
    file = tempfile.NamedTemporaryFile(dir=".")  # noqa: SIM115
    file.write(os.urandom(FILE_BYTES))
    os.fsync(file.fileno())

    def late() -> None:
        pages = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ)
        pages.madvise(mmap.MADV_RANDOM)
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        began, place = time.monotonic(), 0
        while time.monotonic() - began < LATE_S and place < FILE_BYTES:
            place += pages[place] & 0 or mmap.PAGESIZE
        pages.close()

    return late


def quota() -> Callable[[], None]:
    CGROUP.mkdir()
    (CGROUP / "cpu.cfs_quota_us").write_text("10000")
    # The group then gets a processor before the other programs of a busy machine.
    (CGROUP / "cpu.shares").write_text("262144")
    (CGROUP / "cgroup.procs").write_text(str(os.getpid()))

    def late() -> None:
        began = time.monotonic()
        while time.monotonic() - began < LATE_S:
            pass

    return late


PLANTS = {"processor": processor, "disk": disk, "memory": memory, "quota": quota}


def main() -> None:
    name, times = sys.argv[1], int(sys.argv[2])
    late_watch.PAUSE_NS = 0
    late = PLANTS[name]()
    try:
        with LateWatch() as watch:
            for _ in range(times):
                time.sleep(0.4)
                began_ns = clock.mono_ns()
                watch.period(began_ns, 0, 0)
                late()
                now_ns = clock.mono_ns()
                watch.period(now_ns, now_ns - began_ns, 1)
                time.sleep(0.4)
                print(json.dumps([event.text for event in watch.take_events()]), flush=True)
    finally:
        if name == "quota":
            (CGROUP.parent / "cgroup.procs").write_text(str(os.getpid()))
            CGROUP.rmdir()


if __name__ == "__main__":
    main()
