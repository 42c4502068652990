"""Examines the serial port without opening it."""

from __future__ import annotations

import grp
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from acsard.config.settings import Config
from acsard.doctor.finding import Finding, Level
from acsard.host.processes import holders
from acsard.host.serial_ports import BOARDS, serial_devices


def serial_port(config: Config) -> Iterator[Finding]:
    """Yield findings about the port: existence, permissions, and other programs that use it."""
    path = config.mcu.port
    if path == "sim":
        mend = '`acsard ports` lists the ports; write mcu.port = "/dev/acsar", say'
        yield Finding("port", "warning", "the built-in simulator: no robot will move", mend)
        return
    if not os.path.exists(path):
        seen = ", ".join(port.device for port in serial_devices()) or "none at all"
        mend = "plug it in; by-id names outlive replugging (`acsard ports`)"
        yield Finding("port", "failure", f"{path} is not there; there are: {seen}", mend)
        return
    if not stat.S_ISCHR(os.stat(path).st_mode):
        yield Finding("port", "failure", f"{path} is no serial device", "see `acsard ports`")
        return
    yield _permission(path)
    for holder in holders(path):
        level: Level = "ok" if holder.name == "acsard" else "failure"
        mend = "" if level == "ok" else f"end it: kill {holder.pid}; or let it use another port"
        text = f"{path} is held by {holder.name} (pid {holder.pid})"
        yield Finding("port", level, text, mend)
    yield from _hardware(Path(os.path.realpath(path)).name)


def _hardware(name: str) -> Iterator[Finding]:
    """Yield warnings about an unknown board, and about a USB chip that delays bytes."""
    usb = [port for port in serial_devices() if port.device == f"/dev/{name}"]
    if usb and usb[0].usb_id and not usb[0].board:
        known = ", ".join(sorted(BOARDS))
        text = f"{usb[0].usb_id} is none of the usual boards ({known})"
        yield Finding("port", "warning", text, "add it to 70-acsar.rules if it is your MCU")
    timer = Path(f"/sys/class/tty/{name}/device/latency_timer")
    if timer.is_file() and timer.read_text().strip() != "1":
        text = f"its FTDI chip holds bytes back for {timer.read_text().strip()} ms"
        yield Finding("port", "warning", text, f"install 70-acsar.rules, or: echo 1 > {timer}")


def _permission(path: str) -> Finding:
    if os.access(path, os.R_OK | os.W_OK):
        return Finding("port", "ok", f"{path} may be read and written")
    group = _group_of(os.stat(path).st_gid)
    mend = f"sudo usermod -aG {group} $USER, then log in anew (the service has the group itself)"
    return Finding("port", "failure", f"{path} belongs to group {group}; you do not", mend)


def _group_of(number: int) -> str:
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)
