"""The daemon: who hears it, does it run, and what does it say of itself?"""

from __future__ import annotations

import socket
from collections.abc import Iterator

from acsard.bus.address import address_of
from acsard.bus.session import reachable
from acsard.client import connect
from acsard.config.settings import Config
from acsard.doctor.finding import Finding, Level
from acsard.values import AcsardError


def routers(config: Config) -> Iterator[Finding]:
    """Whom does it lend its rights to?"""
    for endpoint in config.bus.connect:
        if endpoint.startswith("tls/"):
            continue
        text = f"connects to {endpoint}: everyone behind that router has the rights of this machine"
        yield Finding("bus", "warning", text, "keep the router on loopback, or behind TLS")


def daemon(config: Config) -> Iterator[Finding]:
    """Is there a daemon, and what does it say?"""
    endpoint, _, tls = address_of(config)
    if not _answers(endpoint):
        mend = "systemctl status acsard; or start it: acsard run"
        yield Finding("daemon", "warning", f"nobody listens at {endpoint}", mend)
        return
    try:
        with connect(endpoint, robot_id=config.robot.id, tls=tls) as robot:
            state = robot.get("state")
    except AcsardError as error:
        yield Finding("daemon", "failure", str(error), "is another program on that port?")
        return
    level: Level = "failure" if state.mode == "fault" else "ok"
    mend = "see the reason; `acsard call clear` releases it" if level == "failure" else ""
    yield Finding("daemon", level, f"{state.mode}: {state.reason}", mend)
    missed, lines = state.counters.get("missed_periods", 0), state.counters.get("lines_sent", 0)
    if missed > 0.01 * max(1, lines):
        mend = "what else runs here? `top`; the service runs real-time"
        yield Finding("daemon", "warning", f"missed {missed} control periods", mend)


def door(config: Config) -> Iterator[Finding]:
    """Is the door to the network open?"""
    for endpoint in map(reachable, config.bus.outside):
        if _answers(endpoint):
            yield Finding("door", "ok", f"open at {endpoint}")
        else:
            mend = "systemctl status acsard-door; `acsard run` opens one by itself"
            yield Finding("door", "warning", f"nobody listens at {endpoint}", mend)


def _answers(endpoint: str) -> bool:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    host = host.strip("[]")
    try:
        socket.create_connection((host, int(port)), timeout=1.0).close()
    except OSError:
        return False
    return True
