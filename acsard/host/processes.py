"""Finds the processes that have a device open, and runs commands.

It reads the open files of each process from /proc, and examines only those below /dev: a call for a
file on a network disk might hang.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

from msgspec import Struct

from acsard.core.values import Ns
from acsard.host.config_file import SEARCH_PATHS

PROC = Path("/proc")

# Of ptys (Documentation/admin-guide/devices.txt); no serial port has one.
PTY_MAJORS = range(136, 144)


class Holder(Struct, frozen=True):
    pid: int
    name: str


class _Open(Struct, frozen=True):
    process: Path
    fd: str

    def device(self) -> tuple[int, int]:
        return _device(self.process / "fd" / self.fd)

    def fdinfo(self) -> list[str]:
        return _text(self.process / "fdinfo" / self.fd).splitlines()


def holders(path: str) -> Iterator[Holder]:
    """Yield each process that has the device at `path` open."""
    for process in dict.fromkeys(descriptor.process for descriptor in _having_open(path)):
        if (holder := _holder(process)) is not None:
            yield holder


def holder_of(path: str) -> Holder | None:
    """Return another process that has the device open, one that locked it first, or None."""
    last = None
    for descriptor in _having_open(path):
        holder = _holder(descriptor.process)
        if holder is None or holder.pid == os.getpid():
            continue
        if any(line.startswith("lock:") for line in descriptor.fdinfo()):
            return holder
        last = holder
    return last


def is_pty(path: str) -> bool:
    return os.major(_number(path)) in PTY_MAJORS


def master_of(path: str) -> Holder | None:
    """Return a process at the other end of the pty `path`, such as a simulator, or None."""
    return next(masters_of(path), None)


def masters_of(path: str) -> Iterator[Holder]:
    """Yield each process at the other end of the pty `path`."""
    if not is_pty(path):
        return
    wanted = _number(path)
    index = f"tty-index:\t{os.minor(wanted) + 256 * (os.major(wanted) - PTY_MAJORS[0])}"
    for descriptor in _open_devices("/ptmx"):
        if index not in descriptor.fdinfo() or not _shares_ptys(descriptor.process, path):
            continue
        if (holder := _holder(descriptor.process)) is not None:
            yield holder


def is_daemon_here(pid: int) -> bool:
    """Return whether the daemon with the process id `pid` runs on this machine.

    A daemon in another container may have the process id of another subcommand here.
    """
    return _runs(pid, "run")


def is_check_here(pid: int) -> bool:
    """Return whether `acsard mcu check` with the process id `pid` runs on this machine."""
    return _runs(pid, "check")


def _runs(pid: int, subcommand: str) -> bool:
    command = _text(PROC / str(pid) / "cmdline").split("\0")
    return _is_acsard(command) and subcommand in command


def config_of(pid: int) -> Path | None:
    """Return the configuration file that a daemon found when it started; None if unknown.

    Only the daemon's user and root may ask.
    """
    process = PROC / str(pid)
    try:
        start = Path(os.readlink(process / "cwd"))
    except OSError:
        return None
    words, variables = (_text(process / name).split("\0") for name in ("cmdline", "environ"))
    named = [word.partition("=")[2] for word in words if word.startswith("--config=")]
    named += [after for word, after in pairwise(words) if word == "--config"]
    named += [one.partition("=")[2] for one in variables if one.startswith("ACSARD_CONFIG=")]
    found = [start / place for place in filter(None, named)]
    found += [start / place for place in SEARCH_PATHS if (start / place).is_file()]
    return found[0] if found else None


def waited_ns(pid: int) -> Ns:
    """Return how long the first thread of a process has waited for a processor; 0 if unknown."""
    try:
        return int((PROC / str(pid) / "schedstat").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0


def is_running(name: str) -> bool:
    return any(_comm(process) == name[:15] for process in _processes())


def _processes() -> Iterator[Path]:
    return PROC.glob("[0-9]*")


def _open_devices(part: str) -> Iterator[_Open]:
    for process in _processes():
        try:
            numbers = os.listdir(process / "fd")
        except OSError:
            # The process has ended, or belongs to another user.
            continue
        for fd in numbers:
            try:
                target = os.readlink(process / "fd" / fd)
            except OSError:
                # The process has closed the descriptor since.
                continue
            if "/dev/" in target and part in target:
                yield _Open(process, fd)


def _having_open(path: str) -> Iterator[_Open]:
    wanted = _device(path)
    for descriptor in _open_devices("") if any(wanted) else ():
        if descriptor.device() == wanted:
            yield descriptor


def _shares_ptys(process: Path, path: str) -> bool:
    try:
        return os.stat(process / "root/dev/pts").st_dev == os.stat(path).st_dev
    except OSError:
        return True  # of another user, so it cannot be known


# Each container has ptys of its own, with the same numbers, on a file system of their own.
def _device(path: str | Path) -> tuple[int, int]:
    try:
        status = os.stat(path)
    except OSError:
        return 0, 0
    number = status.st_rdev
    return number, status.st_dev if os.major(number) in PTY_MAJORS else 0


def _number(path: str | Path) -> int:
    try:
        return os.stat(path).st_rdev
    except OSError:
        return 0


def _holder(process: Path) -> Holder | None:
    name = _name(process)
    return Holder(int(process.name), name) if name else None


def _name(process: Path) -> str:
    # `python -m acsard` and `python /usr/bin/acsard` are "acsard".
    command = _text(process / "cmdline").split("\0")
    return "acsard" if _is_acsard(command) else _comm(process)


def _comm(process: Path) -> str:
    return _text(process / "comm").strip()


def _text(file: Path) -> str:
    try:
        return os.fsdecode(file.read_bytes())
    except OSError:
        return ""


def _is_acsard(command: Sequence[str]) -> bool:
    program = Path(command[0]).name
    if not program.startswith(("python", "pypy")):
        return program == "acsard"
    return any(
        word.endswith("/acsard") or (word == "acsard" and before[:1] == "-" and before[-1] == "m")
        for before, word in pairwise(command)
    )


def run_command(words: tuple[str, ...], within_s: float) -> subprocess.CompletedProcess[str]:
    """Run a command. Raises `OSError`, and `subprocess.TimeoutExpired` after `within_s`."""
    return subprocess.run(words, capture_output=True, text=True, timeout=within_s, check=False)
