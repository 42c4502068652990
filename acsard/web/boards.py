"""The serial ports at which the page may check a board."""

from __future__ import annotations

import os

from msgspec import Struct

from acsard.host.ports import serial_devices

SIMULATOR = "sim"

NO_DEVICE = (
    "No serial port is seen from here. Is the board plugged in? As a service the page has no "
    "device: then at the robot `sudo systemctl stop acsard`, and `acsard mcu check` in a terminal."
)


class Board(Struct, frozen=True):
    """A port, and what is behind it in words."""

    port: str
    what: str


def boards(configured: str) -> list[Board]:
    """The configured one first, those that are plugged in, and the simulator; slow."""
    found: dict[str, str] = {}
    for device in serial_devices():
        name = device.names[0] if device.names else device.device
        own = configured in (device.device, *device.names)
        told = [device.board or device.description, "configured" if own else ""]
        told += [f"held by {holder.name} (process {holder.pid})" for holder in device.holders]
        found[configured if own else name] = ", ".join(filter(None, told))
    if configured != SIMULATOR and configured not in found:
        there = "" if os.path.exists(configured) else ", not there now"
        found = {configured: f"configured{there}", **found}
    found[SIMULATOR] = "the simulator: nothing real moves"
    # What is begun without a look at the list is of the robot that is seen: no other's wheels turn.
    ports = sorted(found, key=lambda port: port != configured)
    return [Board(port, found[port]) for port in ports]
