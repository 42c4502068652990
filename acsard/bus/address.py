"""Where the robot of a configuration is, for a tool that wants to talk to it."""

from __future__ import annotations

from typing import NamedTuple

from acsard.bus.session import reachable
from acsard.config.settings import TLS, Config


class Address(NamedTuple):
    """How to reach a robot."""

    endpoint: str
    robot_id: str
    tls: str
    """Directory with our certificate, "" for none."""


def address_of(
    config: Config,
    connect: str | None = None,
    robot_id: str | None = None,
    tls: str | None = None,
) -> Address:
    """Where the robot of a configuration is, unless the options say otherwise."""
    bus = config.bus
    # The daemon listens only as a peer; plain endpoints need no certificate.
    known = sorted(bus.listen if bus.mode == "peer" else bus.connect, key=_is_tls)
    endpoint = connect or reachable(known[0])
    certificates = (tls or bus.tls) if _is_tls(endpoint) else ""
    return Address(endpoint, robot_id or config.robot.id, certificates)


def _is_tls(endpoint: str) -> bool:
    return endpoint.startswith(TLS)
