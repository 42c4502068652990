"""The serial ports at which the page may check a board."""

from __future__ import annotations

import os

from msgspec import Struct

from acsard.host.serial_ports import serial_devices

SIMULATOR = "sim"

NO_DEVICE = (
    "No serial port is seen from here. Is the board plugged in? As a service the page has no "
    "device: then at the robot `sudo systemctl stop acsard`, and `acsard mcu check` in a terminal."
)


class Board(Struct, frozen=True):
    """A serial port and a description of the device behind it."""

    port: str
    what: str


def boards(configured: str) -> list[Board]:
    """Return the configured port first, then the ports with a device, then the simulator.

    This scans the serial devices and the processes that hold them, so call it in a thread.
    """
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
    # The configured port comes first: a check that is started without looking at the list must run
    # on the robot that the operator sees, because wheels turn.
    ports = sorted(found, key=lambda port: port != configured)
    return [Board(port, found[port]) for port in ports]
