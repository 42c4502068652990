"""List the serial ports: device, stable names, driver, USB id, the process that has the port open,
and the common microcontroller board that the port looks like. If no port looks like a board, the
tool says so. It opens no port. The exit code is 1 if there is no port.
"""

from __future__ import annotations

import argparse
import sys

import msgspec

from acsard.core.formatting import json_line
from acsard.machine.serial_ports import serial_devices

NO_PORT_ADVICE = (
    "check that the board is plugged in, and that its USB cable carries data, not only power; "
    "`dmesg | tail` shows the kernel's messages about USB devices"
)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON")


def main(args: argparse.Namespace) -> int:
    ports = serial_devices()
    if args.json:
        print(json_line(msgspec.json.encode(ports).decode()))
        return 0 if ports else 1
    if not ports:
        print(f"no serial ports: {NO_PORT_ADVICE}", file=sys.stderr)
        return 1
    for port in ports:
        kind = " ".join(filter(None, [port.usb_id, port.driver, port.description]))
        print(f"{port.device}  {kind}".rstrip())
        if port.board:
            print(f"    looks like  {port.board}")
        for name in port.names:
            print(f"    also        {name}")
        for holder in port.holders:
            print(f"    held by     {holder.name} (pid {holder.pid})")
    if not any(port.usb_id for port in ports):
        print(
            f"none of these ports is a USB port, so acsard finds no board: {NO_PORT_ADVICE}",
            file=sys.stderr,
        )
        return 0
    likely = [port for port in ports if port.board]
    if not likely:
        print(
            "no port has the USB id of a common board: unplug the board and run this again; the "
            "port that has disappeared is the board's port",
            file=sys.stderr,
        )
    if len(likely) == 1:
        port = likely[0]
        name = port.names[0] if port.names else port.device
        print(f'\nfor acsard.toml:\n[mcu]\nport = "{name}"')
    return 0
