"""Which process has a device open, as far as procfs lets us see; nothing is opened.

Only what lies in a /dev is looked at: a file on a network disk that hangs would hold us up.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from msgspec import Struct

PROC = Path("/proc")

PTY_MAJORS = range(136, 144)
"""Device numbers of ptys, 256 each; a serial port has another."""


class Holder(Struct, frozen=True):
    """A process that has a device open."""

    pid: int
    name: str


class _Open(Struct, frozen=True):
    """A device that a process has open as descriptor `fd`."""

    process: Path
    fd: str

    def device(self) -> int:
        """Its number."""
        return os.stat(self.process / "fd" / self.fd).st_rdev

    def about(self) -> list[str]:
        """What the kernel tells of the descriptor."""
        return (self.process / "fdinfo" / self.fd).read_text().splitlines()


def holders(path: str) -> Iterator[Holder]:
    """Who has this device open."""
    for process in dict.fromkeys(one.process for one in _having_open(path)):
        try:
            yield _holder(process)
        except OSError:
            continue  # it has ended


def holder_of(path: str) -> Holder | None:
    """Who keeps us out of this device: who has locked it, else one that has it open."""
    found = None
    for one in _having_open(path):
        try:
            if one.process.name != str(os.getpid()):
                found = _holder(one.process)
                if any(line.startswith("lock:") for line in one.about()):
                    return found
        except OSError:
            continue  # it has ended
    return found


def master_of(path: str) -> Holder | None:
    """The process at the other end of a pty; None for a real device."""
    wanted = _number(path)
    if os.major(wanted) not in PTY_MAJORS:
        return None
    index = f"tty-index:\t{os.minor(wanted) + 256 * (os.major(wanted) - PTY_MAJORS[0])}"
    for one in _open_devices("/ptmx"):
        try:
            if index in one.about():
                return _holder(one.process)
        except OSError:
            continue  # it has ended
    return None


def name_of(pid: int) -> str:
    """The program that runs as this process; "" where none does, or may be seen."""
    try:
        return _name(PROC / str(pid))
    except OSError:
        return ""


def waited_ns(pid: int) -> int:
    """For how long the first thread of a process has waited for a processor since it started; 0
    where the kernel does not tell."""
    try:
        return int((PROC / str(pid) / "schedstat").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0


def running(name: str) -> bool:
    """A process of this name runs."""
    for process in _processes():
        try:
            if _comm(process) == name[:15]:
                return True
        except OSError:
            continue  # it has ended
    return False


def _processes() -> Iterator[Path]:
    return PROC.glob("[0-9]*")


def _open_devices(part: str) -> Iterator[_Open]:
    """What every process has open below a /dev, with `part` in its path."""
    for process in _processes():
        try:
            numbers = os.listdir(process / "fd")
        except OSError:
            continue  # it has ended, or is not ours to look at
        for fd in numbers:
            try:
                target = os.readlink(process / "fd" / fd)
            except OSError:
                continue  # closed meanwhile
            if "/dev/" in target and part in target:
                yield _Open(process, fd)


def _having_open(path: str) -> Iterator[_Open]:
    wanted = _number(path)
    for one in _open_devices("") if wanted else ():
        try:
            if one.device() == wanted:
                yield one
        except OSError:
            continue  # closed meanwhile


def _number(path: str) -> int:
    """The device's number; 0 for what is none."""
    try:
        return os.stat(path).st_rdev
    except OSError:
        return 0


def _holder(process: Path) -> Holder:
    return Holder(int(process.name), _name(process))


def _name(process: Path) -> str:
    """The program's name; acsard's own also when Python runs it as a module or script."""
    words = (process / "cmdline").read_bytes().split(b"\0")
    if any(Path(os.fsdecode(word)).name == "acsard" for word in words[:4]):
        return "acsard"
    return _comm(process)


def _comm(process: Path) -> str:
    return (process / "comm").read_text().strip()
