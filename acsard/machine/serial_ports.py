"""Lists the serial ports of this machine, the boards on them, and the processes that use them.

The module reads /sys and /proc and opens no port, so a running robot is not disturbed.
"""

from __future__ import annotations

import os
from pathlib import Path

from msgspec import Struct
from serial.tools import list_ports

from acsard.host.processes import Holder, holders

# Names by USB id. A test checks that deploy/udev/70-acsar.rules has the same ids.
BOARDS: dict[str, str] = {
    "2341:0010": "Arduino Mega 2560",
    "2341:0042": "Arduino Mega 2560 R3",
    "2a03:0042": "Arduino Mega 2560 (arduino.org)",
    "2341:0001": "Arduino Uno",
    "2341:0043": "Arduino Uno R3",
    "2e8a:000a": "Raspberry Pi Pico",
    "1a86:7523": "CH340, on most clones",
    "1a86:55d4": "CH9102",
    "0403:6001": "FTDI FT232R",
    "0403:6015": "FTDI FT-X",
    "10c4:ea60": "Silicon Labs CP210x",
}

BY_ID = Path("/dev/serial/by-id")


class SerialDevice(Struct, frozen=True):
    device: str
    names: list[str]  # symbolic links, which stay when the device is plugged in again
    driver: str
    usb_id: str  # `vid:pid`, hexadecimal
    description: str
    board: str  # by `BOARDS`
    holders: list[Holder]  # that use the port


def serial_devices() -> list[SerialDevice]:
    """Return the serial ports with hardware, sorted by device name."""
    links = _links()
    devices = []
    for port in sorted(list_ports.comports(), key=lambda p: str(p.device)):
        usb_id = "" if port.vid is None else f"{port.vid:04x}:{port.pid:04x}"
        devices.append(
            SerialDevice(
                device=port.device,
                names=links.get(os.path.realpath(port.device), []),
                driver=_driver(Path(port.device).name),
                usb_id=usb_id,
                description=port.description if port.description != "n/a" else "",
                board=BOARDS.get(usb_id, ""),
                holders=list(holders(port.device)),
            )
        )
    return devices


def _links() -> dict[str, list[str]]:
    names: dict[str, list[str]] = {}
    candidates = [Path("/dev/acsar"), *(sorted(BY_ID.iterdir()) if BY_ID.is_dir() else [])]
    for link in candidates:
        if link.is_symlink():
            names.setdefault(os.path.realpath(link), []).append(str(link))
    return names


def _driver(name: str) -> str:
    return Path(os.path.realpath(f"/sys/class/tty/{name}/device/driver")).name.replace("driver", "")
