"""`acsard doctor`: what is wrong on this machine, and how to mend it.

Looks at everything between the configuration and a robot that drives. It opens no port and sends
nothing to a robot.
"""

from __future__ import annotations

import argparse
import grp
import os
import socket
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from msgspec import Struct

from acsard.cli.common import add_config, address_of, find
from acsard.config.settings import Config
from acsard.values import NS_PER_S

Level = Literal["ok", "warning", "failure"]

LEAST_YEAR = 2026
"""A clock before this was never set: boards without a battery start in the past."""


class Finding(Struct, frozen=True):
    """One thing that was looked at; `mend` is what to do unless it is ok."""

    subject: str
    level: Level
    text: str
    mend: str = ""


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "doctor",
        help="find out what is wrong on this machine",
        description="Look at the configuration, the serial port and who holds it, permissions, "
        "clock, real-time limits, certificates, and the daemon if it runs. Each finding comes "
        "with its mend. Exit 0 when nothing fails, 1 when something does.",
    )
    add_config(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Look and tell."""
    import msgspec

    findings = list(examine(args.config))
    if args.json:
        print(msgspec.json.encode(findings).decode())
    else:
        colours = sys.stdout.isatty()
        for finding in findings:
            print(line(finding, colours))
    return 1 if any(finding.level == "failure" for finding in findings) else 0


def line(finding: Finding, colours: bool) -> str:
    """A finding for people."""
    mark = {"ok": "ok  ", "warning": "warn", "failure": "FAIL"}[finding.level]
    if colours:
        mark = f"\033[{ {'ok': 32, 'warning': 33, 'failure': 31}[finding.level] }m{mark}\033[0m"
    text = f"{mark}  {finding.subject}: {finding.text}"
    return f"{text}\n      -> {finding.mend}" if finding.mend else text


def examine(path: str | None) -> Iterator[Finding]:
    """Everything there is to find."""
    from acsard.config.parsing import ConfigError, parse
    from acsard.config.rules import warnings

    where, text = find(path)
    try:
        config = parse(text)
    except ConfigError as error:
        for problem in error.problems:
            yield Finding("configuration", "failure", f"{where}: {problem}", "see acsard.toml")
        return
    yield Finding("configuration", "ok", where)
    for warning in warnings(config):
        yield Finding("configuration", "warning", warning, "see acsard.toml")
    yield from serial_port(config)
    yield from meddlers()
    yield from clock_and_scheduling()
    yield from certificates(config)
    yield from bus(config)


def serial_port(config: Config) -> Iterator[Finding]:
    """Is it there, may we use it, does somebody else?"""
    from acsard.host.ports import BOARDS, serial_devices
    from acsard.host.processes import holders

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
    name = Path(os.path.realpath(path)).name
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


def meddlers() -> Iterator[Finding]:
    """Programs that take serial ports for something else."""
    from acsard.host.processes import running

    if running("brltty"):
        mend = "sudo apt remove brltty, unless you read Braille: it takes CH340 and FTDI ports"
        yield Finding("brltty", "failure", "runs", mend)
    if running("ModemManager") and not Path("/etc/udev/rules.d/70-acsar.rules").is_file():
        mend = "install deploy/udev/70-acsar.rules (`acsard service install` does)"
        yield Finding("ModemManager", "warning", "runs, and talks to new serial ports", mend)


def clock_and_scheduling() -> Iterator[Finding]:
    """Stamps need a clock that was set; the loop likes to be real-time."""
    import resource
    import time

    from acsard.host.clock import now

    year = time.gmtime(now().wall_ns / NS_PER_S).tm_year
    if year < LEAST_YEAR:
        mend = "set it (timedatectl), or let chrony do; odometry stamps are wall-clock times"
        yield Finding("clock", "warning", f"stands in {year}", mend)
    else:
        yield Finding("clock", "ok", f"stands in {year}")
    allowed, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    if os.geteuid() == 0 or allowed != 0:
        yield Finding("real time", "ok", "may be asked for")
    else:
        mend = "run it as the service (deploy/systemd), which has it; without, load adds lateness"
        yield Finding("real time", "warning", "is not allowed for you", mend)


def certificates(config: Config) -> Iterator[Finding]:
    """Are the files of bus.tls there, private and in date?"""
    from acsard.bus.certificates import check, ends_ns
    from acsard.bus.session import CA, CERTIFICATE, KEY
    from acsard.host.clock import now
    from acsard.host.exits import ExitError
    from acsard.messages.report import EXPIRY_DAYS

    if not config.bus.tls:
        return
    directory = Path(config.bus.tls)
    for name in (CA, CERTIFICATE, KEY):
        file = directory / name
        if not os.access(file, os.R_OK):
            text = f"{file} is missing or not yours to read"
            yield Finding("certificates", "failure", text, "`sudo acsard lan init`, or sudo doctor")
        elif name == KEY and file.stat().st_mode & 0o077:
            yield Finding("certificates", "failure", f"others may read {file}", f"chmod 600 {file}")
    try:
        check(config.bus.tls)
    except ExitError as error:
        yield Finding("certificates", "failure", str(error), "see `acsard lan init --help`")
        return
    ends = ends_ns(config.bus.tls)
    if ends is None:
        mend = "pip install 'acsard[lan]' to have it read"
        yield Finding("certificates", "warning", "cannot tell when they end", mend)
        return
    days = (ends - now().wall_ns) / NS_PER_S / 86400
    mend = "`acsard lan renew`, or in a fleet a new one by `lan add`, where ca-key.pem is"
    if days < 0:
        yield Finding("certificates", "failure", f"ended {-days:.0f} days ago", mend)
    elif days < EXPIRY_DAYS:
        yield Finding("certificates", "warning", f"ends in {days:.0f} days", mend)
    else:
        yield Finding("certificates", "ok", f"valid for {days:.0f} days")


def bus(config: Config) -> Iterator[Finding]:
    """Is there a daemon, and what does it say?"""
    from acsard.client import connect
    from acsard.host.exits import ExitError

    for endpoint in config.bus.connect:
        if endpoint.startswith("tls/"):
            continue
        text = f"connects to {endpoint}: everyone behind that router has the rights of this machine"
        yield Finding("bus", "warning", text, "keep the router on loopback, or behind TLS")
    endpoint, _, tls = address_of(config)
    if not _answers(endpoint):
        mend = "systemctl status acsard; or start it: acsard run"
        yield Finding("daemon", "warning", f"nobody listens at {endpoint}", mend)
        return
    try:
        with connect(endpoint, robot_id=config.robot.id, tls=tls) as robot:
            state = robot.get("state")
    except ExitError as error:
        yield Finding("daemon", "failure", str(error), "is another program on that port?")
        return
    level: Level = "failure" if state.mode == "fault" else "ok"
    mend = "see the reason; `acsard call clear` releases it" if level == "failure" else ""
    yield Finding("daemon", level, f"{state.mode}: {state.reason}", mend)
    missed, lines = state.counters.get("missed_periods", 0), state.counters.get("lines_sent", 0)
    if missed > 0.01 * max(1, lines):
        mend = "what else runs here? `top`; the service runs real-time"
        yield Finding("daemon", "warning", f"missed {missed} control periods", mend)


def _answers(endpoint: str) -> bool:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    host = host.strip("[]")
    try:
        socket.create_connection((host, int(port)), timeout=1.0).close()
    except OSError:
        return False
    return True
