"""The findings of `acsard doctor`.

A daemon that runs reports about itself and its robot: each row of its `diagnostics` is one finding,
with the row's advice. The doctor adds what only a program beside it sees: the file and its
certificates, the port, the computer, and whether programs listen where they should. It opens no
serial port, and sends only queries. For a daemon on another machine it examines only the reports
and this machine's certificates.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from acsard.bus.address import Address, address_of
from acsard.bus.tls_files import host_and_port
from acsard.bus.zenoh_sessions import answers, reachable
from acsard.client.connection import Connection, open_connection
from acsard.core.codes import CODES, reason
from acsard.core.config.contradictions import is_loopback, warnings
from acsard.core.config.live import differences
from acsard.core.config.parsing import ConfigError, from_builtins, parse
from acsard.core.config.settings import SIMULATOR, Config, is_tls
from acsard.core.formatting import listed
from acsard.core.messages.schema import DiagnosticStatus, Info
from acsard.core.tables.finding_table import LEVELS
from acsard.core.values import NS_PER_S, AcsardError, Seconds
from acsard.host import clock
from acsard.host.errors import MendableError, NoAnswerError
from acsard.host.own_identity import own_addresses
from acsard.host.processes import is_daemon_here
from acsard.machine.certificate_findings import certificates, router_certificates
from acsard.machine.finding import Finding, about, finding
from acsard.machine.local_findings import computer, serial_port

MAX_KEYS = 6  # in one finding of `compared`

# Set by options of `acsard run`, so a difference to the file is probably intended.
OPTION_KEYS = (
    "mcu.port", "robot.id", "bus.listen", "bus.connect", "record.directory",
    "ros.namespace",
)  # fmt: skip

# Zenoh replaces time stamps from 0.5 s on.
MAX_APART_S = 0.4


class Running(Struct, frozen=True):
    """The answers of a running daemon."""

    info: Info
    config: Config | None  # the daemon's, if known
    rows: tuple[DiagnosticStatus, ...]
    role: str  # this client's role, certificate and name at the daemon
    is_local: bool = True  # it runs on this machine
    ahead_s: Seconds = 0.0  # its clock
    round_trip_s: Seconds = 0.0  # of the query of its clock


def examine(
    where: str,
    text: bytes,
    overrides: dict[str, dict[str, object]],
    find_address: Callable[[Config], Address] = address_of,
) -> Iterator[Finding]:
    """Yield all findings of the doctor, and each remedy once. Raises `UsageError`.

    `overrides` replace values of the file by table and key. `where` is its path. An invalid
    endpoint is a usage error.
    """
    told = {""}
    for found in _findings(where, text, overrides, find_address):
        yield replace(found, mend="") if found.mend in told else found
        told.add(found.mend)


def _findings(
    where: str,
    text: bytes,
    overrides: dict[str, dict[str, object]],
    find_address: Callable[[Config], Address],
) -> Iterator[Finding]:
    try:
        config = parse(text, overrides)
    except ConfigError as error:
        for problem in error.problems:
            yield finding("configuration_wrong", where=where, problem=problem)
        return
    yield finding("configuration_read", where=where)
    address = find_address(config)
    running = query_or_finding(config, address)
    if isinstance(running, Finding):
        yield running
        yield from local(config, address, config.bus.tls, None)
        return
    yield finding("daemon_answers", version=running.info.version, pid=running.info.pid)
    yield finding("role_known", role=running.role)
    yield from reported(running.rows)
    if running.is_local:
        if running.config is None:
            yield finding("configuration_secret")
            return
        yield from compared(running.config, config)
        yield from local(running.config, address, config.bus.tls, running.info.pid)
    else:
        yield finding("daemon_elsewhere")
        yield from clocks(running)
        yield from certificates(address.tls)


def local(config: Config, address: Address, written: str, pid: int | None) -> Iterator[Finding]:
    """Yield what only a program on the daemon's machine sees; `pid` is the daemon's, if it runs.

    `config` is in force; `written` is the certificate directory in the file. systemd gives the
    daemon copies of the certificates at its start, so all directories are examined.
    """
    for warning in warnings(config):
        yield finding("configuration_doubtful", warning=warning)
    if not (config.odometry.calibrated or config.mcu.simulated):
        yield about("calibration", reason("not_calibrated"))
    yield from serial_port(config.mcu.port, config.mcu.simulated and pid is None)
    yield from computer(config.control.real_time, pid)
    for directory in dict.fromkeys((config.bus.tls, address.tls, written)):
        yield from certificates(directory)
    yield from routers(config, running=pid is not None)
    yield from router_certificates(config)
    yield from gateway(config)


def reported(rows: tuple[DiagnosticStatus, ...]) -> Iterator[Finding]:
    """Yield a finding for each row of the daemon's diagnostics, and each reason once."""
    details = [{pair.key: pair.value for pair in row.values} for row in rows]
    codes = Counter(values.get("code") for values in details)
    for row, values in zip(rows, details, strict=True):
        code, advice = values.get("code", ""), values.get("advice", "")
        # The row of the link has the reason for which the robot waits, too.
        if row.level and codes[code] > 1 and not advice:
            continue
        subject, level = row.name.removeprefix("acsard: "), LEVELS[min(row.level, 2)]
        yield Finding(subject, code, level, row.message, advice)


def query_or_finding(config: Config, address: Address) -> Running | Finding:
    """Return the daemon's answers, or a finding. Raises `UsageError` for an invalid endpoint."""
    endpoint = address.endpoint
    if not answers(endpoint):
        if config.bus.mode == "client" and endpoint in map(reachable, config.bus.connect):
            return finding("daemon_behind_router", endpoint=endpoint)
        advice = f"; {address.advice}" if address.advice else ""
        return finding("daemon_absent", endpoint=endpoint, advice=advice)
    try:
        return query(config, address)
    except NoAnswerError as error:
        return finding("daemon_silent", error=error)
    except MendableError as error:
        if error.why is not None:
            return about(CODES["daemon_refuses"].subject, error.why)
        # The text of such an error contains the advice.
        return finding("daemon_refuses", error=error)
    except AcsardError as error:
        return finding("daemon_other_version", error=error)


def query(config: Config, address: Address) -> Running:
    """Query the daemon. Raises an `AcsardError` without an answer.

    The local `config`, with the values of `info`, stands in for one that is not returned, if both
    are of the same robot.
    """
    with open_connection(address) as robot:
        info = robot.get("info")
        runs, rows = _configuration(robot, info, config), tuple(robot.get("diagnostics").status)
        sent, stamp, answered = clock.now(), robot.get("state").stamp, clock.now()
        trip_s = (answered.mono_ns - sent.mono_ns) / NS_PER_S
        ahead_s = (stamp.to_ns() - sent.wall_ns) / NS_PER_S - trip_s / 2
        us = robot.whoami()
        role = f"{us.describe()}; your sender id is {us.sender}"
        return Running(info, runs, rows, role, is_daemon_here(info.pid), ahead_s, trip_s)


def _configuration(robot: Connection, info: Info, file: Config) -> Config | None:
    # Otherwise `file` with the values of `info`, if it is this robot's.
    try:
        return from_builtins(robot.get("config"))
    except (AcsardError, msgspec.ValidationError):  # not permitted, or a daemon of another version
        if file.robot.id != info.id:
            return None
        mcu = replace(file.mcu, port=SIMULATOR if info.simulated else info.port)
        bus = replace(file.bus, listen=tuple(info.listen), connect=tuple(info.connect))
        return replace(file, robot=replace(file.robot, id=info.id), mcu=mcu, bus=bus)


def compared(running: Config, file: Config) -> Iterator[Finding]:
    """Yield a finding about the values of the daemon that differ from those of the file."""
    runs, ours = running.robot.id, file.robot.id
    if runs != ours:
        yield finding("configuration_other_robot", ours=ours, runs=runs)
        return
    others = differences(running, file)
    if not others:
        yield finding("configuration_same")
        return
    texts = [difference.describe(key) for key, difference in others.items()]
    by_options = others.keys() <= set(OPTION_KEYS)
    yield finding(
        "configuration_options" if by_options else "configuration_differs",
        values=listed(texts, MAX_KEYS, "; "),
    )


def clocks(running: Running) -> Iterator[Finding]:
    """Yield a warning if the clock of a daemon on another machine differs from this machine's."""
    # The daemon has read its clock at an unknown moment between the query and the answer.
    if abs(running.ahead_s) > MAX_APART_S + running.round_trip_s / 2:
        way = "ahead of" if running.ahead_s > 0 else "behind"
        yield finding("clock_apart", seconds=abs(running.ahead_s), way=way)


def routers(config: Config, running: bool) -> Iterator[Finding]:
    """Yield warnings about endpoints in `bus.connect` without TLS, or without a program.

    A running daemon reports the latter itself.
    """
    for endpoint in config.bus.connect:
        if not running and not answers(endpoint):
            yield finding("router_absent", endpoint=endpoint)
        if not is_tls(endpoint) and _others_reach(endpoint):
            yield finding("bus_open", endpoint=endpoint)


def _others_reach(endpoint: str) -> bool:
    host, port = host_and_port(endpoint)
    return not is_loopback(host) or any(answers(f"tcp/{own}:{port}") for own in own_addresses())


def gateway(config: Config) -> Iterator[Finding]:
    """Yield a finding for each endpoint of the TLS gateway: does a program listen there?"""
    for endpoint in config.bus.outside:
        yield finding("gateway_open" if answers(endpoint) else "gateway_absent", endpoint=endpoint)
