"""What this machine has: serial ports, who holds them, which boards they are.

Read from sysfs and procfs; nothing is opened, so a running robot is not disturbed.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from msgspec import Struct
from serial.tools import list_ports

BOARDS: dict[tuple[int, int], str] = {
    (0x2341, 0x0010): "Arduino Mega 2560",
    (0x2341, 0x0042): "Arduino Mega 2560 R3",
    (0x2A03, 0x0042): "Arduino Mega 2560 (arduino.org)",
    (0x1A86, 0x7523): "CH340, on most Mega 2560 clones",
    (0x1A86, 0x55D4): "CH9102",
    (0x0403, 0x6001): "FTDI FT232R",
    (0x0403, 0x6015): "FTDI FT-X",
    (0x10C4, 0xEA60): "Silicon Labs CP210x",
}
"""USB ids a robot's microcontroller is found behind; deploy/udev/70-acsar.rules has the same."""

PTY_MAJORS = range(136, 144)
"""Device numbers of ptys, 256 each; a serial port has another."""

BY_ID = Path("/dev/serial/by-id")


class Holder(Struct, frozen=True):
    """A process that has a device open."""

    pid: int
    name: str


class SerialDevice(Struct, frozen=True):
    """One serial port of this machine."""

    device: str
    names: list[str]
    """Stable names for it: by-id links and /dev/acsar."""
    driver: str
    usb_id: str
    """`vid:pid` in hex, "" when it is not on USB."""
    description: str
    board: str
    """Which usual microcontroller board it looks like, "" for none."""
    holders: list[Holder]


def serial_devices() -> list[SerialDevice]:
    """The serial ports that are plugged in; those without hardware behind them are left out."""
    links = _links()
    found = []
    for port in sorted(list_ports.comports(), key=lambda p: str(p.device)):
        usb = port.vid is not None and port.pid is not None
        found.append(
            SerialDevice(
                device=port.device,
                names=links.get(os.path.realpath(port.device), []),
                driver=_driver(Path(port.device).name),
                usb_id=f"{port.vid:04x}:{port.pid:04x}" if usb else "",
                description=port.description if port.description != "n/a" else "",
                board=BOARDS.get((port.vid, port.pid), ""),
                holders=list(holders(port.device)),
            )
        )
    return found


def holders(path: str) -> Iterator[Holder]:
    """Who has this device open, as far as we may see it."""
    try:
        wanted = os.stat(path).st_rdev
    except OSError:
        return
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if any(_is_device(entry, wanted) for entry in os.scandir(process / "fd")):
                yield Holder(int(process.name), _name(process))
        except OSError:
            continue  # ended meanwhile, or not ours to see


def master_of(path: str) -> Holder | None:
    """The process at the other end of a pty, as far as we may see it; None for a real device."""
    try:
        device = os.stat(path).st_rdev
    except OSError:
        return None
    if os.major(device) not in PTY_MAJORS:
        return None
    index = f"tty-index:\t{os.minor(device) + 256 * (os.major(device) - PTY_MAJORS[0])}"
    for process in Path("/proc").glob("[0-9]*"):
        try:
            for entry in os.scandir(process / "fd"):
                if not os.readlink(entry.path).endswith("/ptmx"):
                    continue
                if index in (process / "fdinfo" / entry.name).read_text().splitlines():
                    return Holder(int(process.name), _name(process))
        except OSError:
            continue  # ended meanwhile, or not ours to see
    return None


def _name(process: Path) -> str:
    """The program's name; acsard's own also when Python runs it as a module or script."""
    words = (process / "cmdline").read_bytes().split(b"\0")
    if any(Path(os.fsdecode(word)).name == "acsard" for word in words[:4]):
        return "acsard"
    return (process / "comm").read_text().strip()


def running(name: str) -> bool:
    """A process of this name runs."""
    for comm in Path("/proc").glob("[0-9]*/comm"):
        try:
            if comm.read_text().strip() == name[:15]:
                return True
        except OSError:
            continue
    return False


def _is_device(entry: os.DirEntry[str], wanted: int) -> bool:
    try:
        return wanted != 0 and os.stat(entry.path).st_rdev == wanted
    except OSError:
        return False


def _links() -> dict[str, list[str]]:
    names: dict[str, list[str]] = {}
    candidates = [Path("/dev/acsar"), *(sorted(BY_ID.iterdir()) if BY_ID.is_dir() else [])]
    for link in candidates:
        if link.is_symlink():
            names.setdefault(os.path.realpath(link), []).append(str(link))
    return names


def _driver(name: str) -> str:
    return Path(os.path.realpath(f"/sys/class/tty/{name}/device/driver")).name.replace("driver", "")
