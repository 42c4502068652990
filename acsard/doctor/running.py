"""The daemon that runs, asked: with what it was started, and how it is a second later."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import msgspec
from msgspec import Struct

from acsard.bus.address import address_of
from acsard.bus.session import reachable
from acsard.client import Client, connect
from acsard.config.live import flat, live
from acsard.config.parsing import effective, from_builtins
from acsard.config.settings import Config
from acsard.doctor.finding import Finding
from acsard.host import clock
from acsard.messages.schema import DiagnosticStatus, Info, RobotState
from acsard.values import AcsardError

WATCHED_S = 1.0
"""Over so long lines are counted: a hundred of them."""

SHOWN = 6
"""Keys that are named one by one; more are another file."""


WAYS = (
    (
        False,
        "(by its options or environment, or the file has changed since)",
        "what follows is of the daemon; to have the file's, start it anew without those options",
    ),
    (
        True,
        "(set while it ran, or the file has changed since)",
        "its next start has the file's; `acsard set KEY VALUE --write` puts one into the file",
    ),
)
"""How a value can be another than the file's, by whether it can be set, and what to do."""


class Running(Struct, frozen=True):
    """What a daemon says: who it is, its configuration, and two looks at its state."""

    info: Info
    config: Config
    before: RobotState
    state: RobotState
    looked_ns: int
    """When that was asked for, by this machine's wall clock."""
    rows: tuple[DiagnosticStatus, ...] = ()
    """Its diagnostics."""


def asked(config: Config) -> Running:
    """The daemon where this configuration has it; raises an `AcsardError`."""
    endpoint, robot_id, tls = address_of(config)
    with connect(endpoint, robot_id=robot_id, tls=tls) as robot:
        info, before = robot.get("info"), robot.get("state")
        time.sleep(WATCHED_S)
        rows = tuple(robot.get("diagnostics").status)
        runs, state = _configuration(robot, info, config), robot.get("state")
        return Running(info, runs, before, state, clock.now().wall_ns, rows)


def _configuration(robot: Client, info: Info, file: Config) -> Config:
    """What it was started with; what `info` has of it, for those who may not ask for the rest."""
    try:
        return from_builtins(robot.get("config"))
    except (AcsardError, msgspec.ValidationError):  # not permitted, or another version's
        mcu = msgspec.structs.replace(file.mcu, port="sim" if info.simulated else info.port)
        return msgspec.structs.replace(file, mcu=mcu)


def differences(runs: Config, file: Config) -> dict[str, str]:
    """Each key that the daemon has otherwise than the file, with both values in words."""
    its, ours = dict(flat(effective(runs))), dict(flat(effective(file)))
    return {
        key: f"{key} = {_text(its.get(key))}, not {_text(ours.get(key))}"
        for key in its | ours
        if its.get(key) != ours.get(key)
    }


def compared(running: Running, file: Config) -> Iterator[Finding]:
    """Does it run with what the file says?"""
    info, others = running.info, differences(running.config, file)
    who = f"acsard {info.version}, pid {info.pid}"
    if not others:
        yield Finding("configuration", "ok", f"the daemon that runs ({who}) has it")
        return
    for settable, how, mend in WAYS:
        told = [words for key, words in others.items() if (live(key) is not None) == settable]
        if told:
            more = f"; and {len(told) - SHOWN} more" if len(told) > SHOWN else ""
            text = f"the daemon that runs ({who}) has other values {how}: "
            text += f"{'; '.join(told[:SHOWN])}{more}"
            yield Finding("configuration", "warning", text, mend)


def answers(endpoint: str) -> bool:
    """Somebody listens there."""
    host, _, port = reachable(endpoint).partition("/")[2].rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=1.0).close()
    except OSError:
        return False
    return True


def _text(value: object) -> str:
    return msgspec.json.encode(value).decode()
