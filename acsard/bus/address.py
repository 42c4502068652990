"""Where the robot of a configuration is, for a tool that wants to talk to it."""

from __future__ import annotations

from typing import NamedTuple

from msgspec import ValidationError, convert

from acsard.bus.session import reachable
from acsard.config.settings import TLS, Config, Name
from acsard.host.errors import UsageError


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
    """Where the robot of a configuration is, unless the options say otherwise.

    Raises `UsageError` for an id that no robot can have.
    """
    robot_id = config.robot.id if robot_id is None else robot_id
    require_id(robot_id)
    bus = config.bus
    # The daemon listens only as a peer; plain endpoints need no certificate.
    known = sorted(bus.listen if bus.mode == "peer" else bus.connect, key=_is_tls)
    endpoint = connect or reachable(known[0])
    certificates = (tls or bus.tls) if _is_tls(endpoint) else ""
    return Address(endpoint, robot_id, certificates)


def require_id(robot_id: str) -> None:
    """Raises `UsageError` for what no robot can be called."""
    try:
        convert(robot_id, Name)
    except ValidationError:
        raise UsageError(
            f"{robot_id!r} is not a robot's id: write 1 to 32 of A-Z a-z 0-9 _ -, as robot.id "
            "in its acsard.toml"
        ) from None


def _is_tls(endpoint: str) -> bool:
    return endpoint.startswith(TLS)
