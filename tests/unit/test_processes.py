"""Which process has a device open, and which one is acsard."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from acsard.host import processes
from acsard.host.child import (
    acsard,
)
from acsard.host.processes import holder_of, holders, master_of
from tests.each import each

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
    for descriptor in ends:
        os.close(descriptor)


def test_each_process_that_has_the_device_open_is_listed_once(device: str) -> None:
    again = os.open(device, os.O_RDWR | os.O_NOCTTY)
    with another(device) as pid:
        pids = [holder.pid for holder in holders(device)]
        assert (pids.count(os.getpid()), pids.count(pid)) == (1, 1)
    os.close(again)
    pids = [holder.pid for holder in holders(device)]
    assert (pids.count(os.getpid()), pids.count(pid)) == (1, 0)


def test_the_holder_of_a_device_is_the_process_with_the_lock(device: str) -> None:
    assert holder_of(device) is None, "this process does not count as the holder"
    with another(device, "lock") as locker, another(device), another(device):
        holder = holder_of(device)
        assert holder is not None
        assert holder.pid == locker


def test_the_other_end_of_a_pty_is_found_and_a_real_device_has_none(device: str) -> None:
    other = master_of(device)
    assert other is not None
    assert other.pid == os.getpid()
    assert master_of("/dev/null") is None


@pytest.mark.parametrize("path", ["/dev/acsar_that_is_not", "/etc/passwd", "/tmp"])
def test_a_path_that_is_not_a_device_has_no_holder(path: str) -> None:
    assert (list(holders(path)), holder_of(path), master_of(path)) == ([], None, None)


@each(
    ("command", "name"),
    [
        (tuple(acsard("run")), "acsard run"), (("acsard", "sim"), "acsard"),
        (("/opt/acsard/0.2.0/bin/acsard", "run", "--config", "x.toml"), "acsard run"),
        (("/usr/bin/python3.13", "/opt/acsard/0.2.0/bin/acsard", "run"), "acsard run"),
        (("python", "-m", "acsard", "run"), "acsard run"),
        (("python3", "-PBm", "acsard"), "acsard"),
        (("python3", "-P", "-X", "utf8", "bin/acsard", "web"), "acsard"),
        (("screen", "-S", "acsard", "/dev/ttyACM0"), "other"),
        (("tail", "-f", "/dev/null", "/tmp/acsard"), "other"),
        (("python3", "logger.py", "acsard"), "other"), (("python3", "-m", "other", "run"), "other"),
        (("python3", "-m", "serial.tools.miniterm", "acsard"), "other"),
        (("python3", "-c", "input()", "acsard"), "other"), (("python3", "-X", "acsard"), "other"),
        (("python3", "-", "acsard"), "other"), (("python3",), "other"), ((), "other"),
    ],
)  # fmt: skip
def test_only_a_process_that_executes_acsard_has_its_name_and_a_daemon_runs_run(
    command: tuple[str, ...], name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page and the daemon in two containers may both have the process id 1."""
    monkeypatch.setattr(processes, "PROC", tmp_path)
    (tmp_path / "1").mkdir(exist_ok=True)
    (tmp_path / "1" / "cmdline").write_bytes(b"".join(word.encode() + b"\0" for word in command))
    (tmp_path / "1" / "comm").write_text("other\n")
    assert processes._name(tmp_path / "1") == name.removesuffix(" run")
    assert processes.is_daemon_here(1) is name.endswith(" run")
