"""Tests of the search for processes that have a device open, with ptys of this process."""

from __future__ import annotations

import fcntl
import os
import pty
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from acsard.host import processes
from acsard.host.child import acsard
from acsard.host.processes import holder_of, holders, is_running, master_of, name_of, waited_ns
from tests.system.harness import until

HOLD = """\
import fcntl, os, sys
fd = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
if len(sys.argv) > 2:
    fcntl.flock(fd, fcntl.LOCK_EX)
print("held", flush=True)
sys.stdin.read()
"""


@contextmanager
def another(path: str, *words: str) -> Iterator[int]:
    """Yield the pid of another process that has the device open.

    With a second argument the process also locks the device.
    """
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, path, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        yield process.pid
        assert process.stdin is not None
        process.stdin.close()


@pytest.fixture
def device() -> Iterator[str]:
    """Yield the path of a pty. This process has opened both of its ends."""
    ends = pty.openpty()
    yield os.ttyname(ends[1])
    for end in ends:
        os.close(end)


def test_each_process_that_has_the_device_open_is_listed_once(device: str) -> None:
    again = os.open(device, os.O_RDWR | os.O_NOCTTY)
    with another(device) as pid:
        assert sorted(holder.pid for holder in holders(device)) == sorted([os.getpid(), pid])
    os.close(again)
    assert [holder.pid for holder in holders(device)] == [os.getpid()]


def test_the_holder_of_a_device_is_the_process_with_the_lock(device: str) -> None:
    assert holder_of(device) is None, "this process does not count as the holder"
    with another(device, "lock") as locker, another(device), another(device):
        holder = holder_of(device)
        assert holder is not None
        assert holder.pid == locker


def test_without_a_lock_the_holder_is_another_process_with_the_device_open(device: str) -> None:
    own = os.open(device, os.O_RDWR | os.O_NOCTTY)
    fcntl.flock(own, fcntl.LOCK_EX)
    with another(device) as pid:
        holder = holder_of(device)
        assert holder is not None
        assert holder.pid == pid
    os.close(own)


def test_the_other_end_of_a_pty_is_found_and_a_real_device_has_none(device: str) -> None:
    other = master_of(device)
    assert other is not None
    assert other.pid == os.getpid()
    assert master_of("/dev/null") is None


@pytest.mark.parametrize("path", ["/dev/acsar_that_is_not", "/etc/passwd", "/tmp"])
def test_a_path_that_is_not_a_device_has_no_holder(path: str) -> None:
    assert list(holders(path)) == []
    assert holder_of(path) is None
    assert master_of(path) is None


def test_a_program_is_found_by_its_name(device: str) -> None:
    with another(device) as pid:
        (holder,) = [process for process in holders(device) if process.pid == pid]
        assert is_running(holder.name)
    assert not is_running("no such program")


def test_a_process_that_is_not_there_has_no_name() -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    assert name_of(os.getpid()) != ""
    assert name_of(ended.pid) == ""


@pytest.mark.parametrize(
    ("command", "name"),
    [
        (tuple(acsard("run")), "acsard"),
        (("acsard", "sim"), "acsard"),
        (("/opt/acsard/0.2.0/bin/acsard", "run"), "acsard"),
        (("/usr/bin/python3.13", "/opt/acsard/0.2.0/bin/acsard", "run"), "acsard"),
        (("python", "-m", "acsard", "run"), "acsard"),
        (("python3", "-PBm", "acsard"), "acsard"),
        (("python3", "-X", "utf8", "-Wignore", "-macsard"), "acsard"),
        (("python3", "-P", "-X", "utf8", "bin/acsard"), "acsard"),
        (("screen", "-S", "acsard", "/dev/ttyACM0"), "other"),
        (("tail", "-f", "/dev/null", "/tmp/acsard"), "other"),
        (("python3", "logger.py", "acsard"), "other"),
        (("python3", "-m", "serial.tools.miniterm", "acsard"), "other"),
        (("python3", "-c", "input()", "acsard"), "other"),
        (("python3", "-X", "acsard"), "other"),
        (("python3", "-", "acsard"), "other"),
        (("python3",), "other"),
        ((), "other"),
    ],
)
def test_only_a_process_that_executes_acsard_has_its_name(
    command: tuple[str, ...], name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "PROC", tmp_path)
    (tmp_path / "77").mkdir()
    (tmp_path / "77" / "cmdline").write_bytes(b"".join(word.encode() + b"\0" for word in command))
    (tmp_path / "77" / "comm").write_text("other\n")
    assert name_of(77) == name


@pytest.mark.parametrize(
    ("command", "here"),
    [
        (("/opt/acsard/0.2.0/bin/acsard", "run", "--config", "robot.toml"), True),
        (tuple(acsard("run")), True),
        (("python3", "bin/acsard", "web"), False),
        (("python3", "-m", "other", "run"), False),
        ((), False),
    ],
)
def test_a_daemon_is_here_only_if_its_process_runs_one(
    command: tuple[str, ...], here: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page and the daemon in two containers may both have the process id 1."""
    monkeypatch.setattr(processes, "PROC", tmp_path)
    (tmp_path / "1").mkdir()
    (tmp_path / "1" / "cmdline").write_bytes(b"".join(word.encode() + b"\0" for word in command))
    assert processes.is_daemon_here(1) is here


def test_another_program_with_the_word_acsard_keeps_its_own_name() -> None:
    with subprocess.Popen(["sh", "-c", "read line", "acsard"], stdin=subprocess.PIPE) as process:
        assert name_of(process.pid) != "acsard"


def test_the_time_that_a_process_waited_for_a_processor_is_read() -> None:
    spin = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\nwhile True: pass"
    two = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(2)]
    try:
        until(
            lambda: all(waited_ns(process.pid) > 20_000_000 for process in two),
            20.0,
            "both have waited",
        )
    finally:
        for process in two:
            process.kill()
            process.wait()
    assert waited_ns(two[0].pid) == 0  # the process has ended
