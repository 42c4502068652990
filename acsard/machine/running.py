"""Asks the running daemon for its configuration, and for its state twice, a second apart."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator, Mapping

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from acsard.client import Client, connect
from acsard.core.config.live import Difference, differences, live
from acsard.core.config.parsing import from_builtins
from acsard.core.config.settings import SIMULATOR, Config
from acsard.core.config.validation import write
from acsard.core.formatting import listed
from acsard.core.messages.schema import DiagnosticStatus, Info, LogEvent, RobotState
from acsard.core.values import AcsardError
from acsard.daemon.bus.address import Address
from acsard.daemon.bus.zenoh_sessions import no_endpoint, reachable
from acsard.host import clock
from acsard.host.processes import name_of
from acsard.machine.finding import Finding, Level

SHOWN = 6
"""Number of differing keys that are named one by one. More mean another file."""


OPTIONS = (
    "mcu.port", "mcu.baud_rate", "robot.id", "bus.listen", "bus.connect", "record.directory",
    "ros.namespace",
)  # fmt: skip
"""Keys that `acsard run` takes as options, so that a different value is intended."""

WAYS: tuple[tuple[Callable[[str], bool], Level, str, str], ...] = (
    (
        lambda key: key in OPTIONS,
        "ok",
        "by its options (`acsard run --help`) or another file, or the file has changed since",
        "to keep {which}, write into the file: {lines}",
    ),
    (
        lambda key: key not in OPTIONS and live(key) is None,
        "warning",
        "by another file or its environment, or the file has changed since",
        "if it runs with another file, name that with --config; otherwise write its values into "
        "the file, or restart it. The following is about the running daemon",
    ),
    (
        lambda key: live(key) is not None,
        "warning",
        "set while it ran, or by another file, or the file has changed since",
        "its next start uses the file's values; `acsard set KEY VALUE --write` writes one into "
        "the file",
    ),
)
"""Reasons for a value that differs from the file's, by its key, and the remedy."""


class Running(Struct, frozen=True):
    """Reports of a daemon: its identity, its configuration, and two of its states."""

    info: Info
    config: Config
    before: RobotState
    state: RobotState
    looked_ns: int
    """Middle of the query of `state`, from request to answer, by this machine's wall clock, ns."""
    trip_ns: int = 0
    """Duration of that request, ns."""
    rows: tuple[DiagnosticStatus, ...] = ()
    """Rows of the daemon's diagnostics."""
    here: bool = True
    """Whether the daemon runs on this machine, as far as its processes can be seen.

    A tunnel or a router may stand between.
    """
    events: tuple[LogEvent, ...] = ()
    """The daemon's last events."""


def asked(config: Config, address: Address) -> Running:
    """Ask the daemon at this address. `config` is the configuration in the file.

    Raises an `AcsardError` if it cannot be asked.
    """
    endpoint, robot_id, tls = address
    with connect(endpoint, robot_id=robot_id, tls=tls) as robot:
        info, before = robot.get("info"), robot.get("state")
        time.sleep(1.0)  # about a hundred lines are counted meanwhile
        rows, events = tuple(robot.get("diagnostics").status), tuple(robot.get("events").events)
        runs, here = _configuration(robot, info, config), name_of(info.pid) == "acsard"
        asked = clock.now()
        state, answered = robot.get("state"), clock.now()
        trip_ns = answered.mono_ns - asked.mono_ns
        looked_ns = asked.wall_ns + trip_ns // 2
        return Running(info, runs, before, state, looked_ns, trip_ns, rows, here, events)


def _configuration(robot: Client, info: Info, file: Config) -> Config:
    """Return the daemon's configuration.

    A client that may not query it gets the file's, with the values that `info` contains.
    """
    try:
        return from_builtins(robot.get("config"))
    except (AcsardError, msgspec.ValidationError):  # not permitted, or a daemon of another version
        mcu = replace(file.mcu, port=SIMULATOR if info.simulated else info.port)
        bus = replace(file.bus, listen=tuple(info.listen), connect=tuple(info.connect))
        return replace(file, robot=replace(file.robot, id=info.id), mcu=mcu, bus=bus)


def compared(running: Running, file: Config) -> Iterator[Finding]:
    """Yield findings about the agreement of the daemon's configuration with the file."""
    info, others = running.info, differences(running.config, file)
    who = f"acsard {info.version}, pid {info.pid}"
    if not others:
        yield Finding("configuration", "ok", f"the running daemon ({who}) has that of the file")
        return
    for belongs, level, how, mend in WAYS:
        its = {key: one for key, one in others.items() if belongs(key)}
        if not its:
            continue
        told = [one.words(key) for key, one in its.items()]
        text = f"the running daemon ({who}) has other values ({how}): "
        text += listed(told, SHOWN, "; ")
        mend = mend.format(which="them" if len(its) > 1 else "it", lines=_tables(its))
        yield Finding("configuration", level, text, mend)


def _tables(its: Mapping[str, Difference]) -> str:
    """Return the daemon's values as lines of the file."""
    parts = [(key.rpartition("."), write(one.its)) for key, one in its.items()]
    return "; ".join(f"[{table}] {name} = {value}" for (table, _, name), value in parts)


def answers(endpoint: str) -> bool:
    """Return whether a program listens at the endpoint.

    Raises `UsageError` if it is not an endpoint.
    """
    host, _, port = reachable(endpoint).partition("/")[2].rpartition(":")
    if not (host and port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise no_endpoint(endpoint)
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=1.0).close()
    except OSError:
        return False
    return True
