"""Run the daemon in the foreground until SIGTERM or Ctrl-C; the robot ramps to zero before the
daemon ends. If no port is configured, the daemon runs the built-in simulator.
"""

from __future__ import annotations

import argparse
import asyncio
import faulthandler
import os
import shlex
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

from acsard.bus.address import address_of
from acsard.bus.robot_discovery import ALL_ROBOTS, running_robots
from acsard.bus.tls_files import name_warnings
from acsard.bus.zenoh_sessions import reachable
from acsard.cli.common import add_config, add_port, load, with_record_directory
from acsard.client.connection import open_connection
from acsard.core.config.contradictions import warnings
from acsard.core.config.settings import Config
from acsard.core.values import ROOT_KEY, AcsardError, Event
from acsard.daemon import daemon
from acsard.host.errors import InUseError
from acsard.host.event_loop import EventLoop
from acsard.host.logs import Log, Writer
from acsard.host.version import version

_BANNER = """\
acsard {version}, robot {robot}
  port    {port}
  bus     {listen}, keys {root}/{robot}/...   (`acsard topics` lists them)
{page}  config  {where}
  try, in a second terminal:
    acsard drive{reach}      drive it with the keyboard
    acsard top{reach}        show position, speeds and faults on one screen
    acsard call stop{reach}  stop it, and keep it stopped until `acsard call clear`
"""

_PAGE = '  page    {where}, for a browser, when "page ready" stands below\n'
_FROM_AFAR = "          on your own computer, type `ssh -L {port}:{host}:{port} {login}` first\n"


def add_options(parser: argparse.ArgumentParser) -> None:
    add_config(parser)
    add_port(parser)
    parser.add_argument("--id", metavar="ID", help="the robot's id on the bus")
    parser.add_argument(
        "--namespace", metavar="NAME", help="prefix of the robot's ROS topics (ros.namespace)"
    )
    parser.add_argument(
        "--listen",
        metavar="ENDPOINT",
        help="bus address to listen at instead of bus.listen, e.g. tcp/127.0.0.1:7448",
    )
    parser.add_argument(
        "--connect",
        metavar="ENDPOINT",
        help="Zenoh router to connect to instead of the one in bus.connect, e.g. "
        "tcp/127.0.0.1:7447",
    )
    parser.add_argument(
        "--record",
        metavar="DIRECTORY",
        help="directory in which the daemon records all inputs and all lines that it sends to the "
        "board (record.directory); `acsard recording` reads it",
    )
    parser.add_argument(
        "--no-gateway",
        action="store_true",
        help="do not start `acsard gateway` for the tls/ endpoints; use this option if the gateway "
        "already runs as a service",
    )


def options(args: argparse.Namespace) -> dict[str, object]:
    """Return the options by dotted key; None if they were not typed."""
    return {
        "mcu.port": args.port,
        "robot.id": args.id,
        "ros.namespace": args.namespace,
        "record.directory": args.record,
        "bus.listen": [args.listen] if args.listen else None,
        "bus.connect": [args.connect] if args.connect else None,
    }


def main(args: argparse.Namespace) -> int:
    where, config = load(args.config, options(args))
    config = with_record_directory(config)
    unexpected = warnings(config) + name_warnings(config)
    log, screen, served = Log(config.log), Writer(sys.stdout), page(config, where)

    def announce(device: str, trouble: str) -> None:
        simulated = config.mcu.simulated
        # Under systemd, the log line below contains the same information as the banner.
        if "INVOCATION_ID" not in os.environ:
            # Do not use print, because a full pipe that no program reads would block the control
            # loop.
            text = banner(
                config, where, device, trouble, reach(args), None if served is None else _login()
            )
            screen.write(f"{text}\n")
        log.info(
            "started",
            version=version(),
            robot=config.robot.id,
            port=device,
            simulated=simulated,
            rate=config.rate_hz,
            bus=_bus(config),
            config=where,
        )
        for text in unexpected:
            log.event(Event("configuration", text, "warning"))

    gateway = ["gateway", "--id", config.robot.id, "--namespace", config.ros.namespace]
    gateway += ["--config", where] if config.bus.outside else []
    # The systemd watchdog ends a hanging daemon with SIGABRT. With this handler, the daemon then
    # writes a traceback of the hang to standard error. `sys.stderr` is None if standard error was
    # closed before the start.
    if sys.stderr is not None:
        faulthandler.enable()
    try:
        with asyncio.Runner(loop_factory=EventLoop) as runner:
            own_gateway = None if args.no_gateway else gateway
            runner.run(daemon.run(config, log, announce, own_gateway, served))
    except InUseError as error:
        raise InUseError(_owner(config) or str(error)) from error
    finally:
        log.close()
        screen.close(0.2)
    return 0


def _owner(config: Config) -> str:
    # Says which daemon already runs, if one answers at the address of this one.
    address = address_of(config)
    endpoint = address.endpoint
    with suppress(AcsardError), open_connection(address) as there:
        ids = running_robots(there.session, (ALL_ROBOTS, address.robot_id), endpoint)
        # Behind a router are other computers' robots, too.
        if ids and not there.session.info.routers_zid():
            with open_connection(address._replace(robot_id=ids[0])) as robot:
                pid = robot.get("info").pid
            return (
                f"acsard already runs: the process {pid} answers at {endpoint} as robot {ids[0]}. "
                f"Use it, or end it: `kill {pid}`, or `sudo systemctl stop acsard` if it is the "
                "service. For a second daemon, choose another address with --listen or in "
                "bus.listen"
            )
    return ""


def page(config: Config, where: str) -> list[str] | None:
    """Return the arguments that serve the robot's page, or None.

    It is served with `web.page`, at a terminal, not as a systemd service, and with its libraries.
    """
    looked_at = sys.stdout is not None and sys.stdout.isatty() and "INVOCATION_ID" not in os.environ
    there = all(map(find_spec, ("aiohttp", "prometheus_client", "segno")))
    if not (config.web.page and looked_at and there):
        return None

    words = ["web", "--id", config.robot.id]
    if Path(where).is_file():
        words += ["--config", where]
    if config.bus.plain:
        words += ["--connect", reachable(config.bus.plain[0])]
    return words


def _bus(config: Config) -> str:
    bus = config.bus
    if bus.mode == "client":
        return f"client of the Zenoh router at {', '.join(bus.connect)}"
    return ", ".join(bus.listen)


def reach(args: argparse.Namespace) -> str:
    """Return the options with which a tool connects to this daemon, such as " --id robot2"."""
    listens = args.listen and reachable(args.listen)
    pairs = (("--config", args.config), ("--connect", listens), ("--id", args.id))
    return "".join([f" {name} {shlex.quote(value)}" for name, value in pairs if value])


def _login() -> str:
    # The user and the address to which this terminal is logged in, "" if it is none of SSH.
    words = os.environ.get("SSH_CONNECTION", "").split()
    return f"{os.environ.get('USER', 'USER')}@{words[2]}" if len(words) == 4 else ""


def _page_lines(addresses: Sequence[str], login: str) -> str:
    lines = _PAGE.format(where=", ".join(addresses))
    here = next((urlsplit(text) for text in addresses if text.startswith("http://")), None)
    if login and here is not None:
        lines += _FROM_AFAR.format(port=here.port or 80, host=here.hostname, login=login)
    return lines


def banner(
    config: Config,
    where: str,
    device: str,
    trouble: str = "",
    reach: str = "",
    served: str | None = None,
) -> str:
    """Return the banner of the start; `trouble` says why the device is not open yet.

    If the page is served, `served` is the login that reaches this computer, "" at its own screen.
    """
    port = f"{device} at {config.mcu.baud_rate} baud"
    if trouble:
        port = f"none yet: {trouble}"
    if config.mcu.simulated:
        port = f"the built-in SIMULATOR ({device}); no real robot will move"
    return _BANNER.format(
        version=version(),
        robot=config.robot.id,
        port=port,
        listen=_bus(config),
        root=ROOT_KEY,
        page="" if served is None else _page_lines(config.web.address, served),
        where=where,
        reach=reach,
    )
