"""Finds the endpoint, the robot id and the certificate directory for a client of a robot."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from msgspec import ValidationError, convert

from acsard.bus.zenoh_sessions import reachable
from acsard.core.config.parsing import ConfigError, parse
from acsard.core.config.settings import Config, Name, is_tls
from acsard.host.config_file import read
from acsard.host.errors import UsageError


class Address(NamedTuple):
    endpoint: str
    robot_id: str
    tls: str  # directory of the client's certificate; "" without TLS
    advice: str = ""  # if no daemon is there


def address_of(
    config: Config,
    connect: str | None = None,
    robot_id: str | None = None,
    tls: str | None = None,
) -> Address:
    """Return a robot's address from its configuration; options that are given win.

    `tls` is ignored if the endpoint needs no certificate. Raises `UsageError` for a malformed id.
    """
    robot_id = config.robot.id if robot_id is None else robot_id
    require_id(robot_id)
    bus = config.bus
    # The daemon listens only in peer mode. A tcp endpoint comes first, because it needs no
    # certificate.
    endpoints = sorted(bus.listening or bus.connect, key=is_tls)
    endpoint = reachable(endpoints[0]) if connect is None else connect
    certificates = (bus.tls if tls is None else tls) if is_tls(endpoint) else ""
    advice = ""
    if connect is None and bus.mode == "peer" and bus.connect:
        advice = (
            'if this computer has no daemon, write bus.mode = "client" into its configuration '
            "file: then the tools connect to bus.connect"
        )
    return Address(endpoint, robot_id, certificates, advice)


def address_by_environment(endpoint: str | None, robot_id: str | None, tls: str | None) -> Address:
    """Return a robot's address for a program that uses the client library.

    An argument that is None comes from the file that $ACSARD_CONFIG names, or is the default.
    $ACSARD_TLS wins over the file. Raises `UsageError` for a malformed id or an unusable file.
    """
    file = os.environ.get("ACSARD_CONFIG")
    overrides: dict[str, dict[str, object]] = {}
    if "ACSARD_TLS" in os.environ:
        overrides["bus"] = {"tls": os.environ["ACSARD_TLS"]}
    try:
        config = parse(read(Path(file)) if file else b"", overrides)
    except OSError as error:
        raise UsageError(
            f"cannot read {file}, which ACSARD_CONFIG names: {error.strerror}; set ACSARD_CONFIG "
            "to an existing file, or unset it"
        ) from None
    except ConfigError as error:
        where = f"{file}, which ACSARD_CONFIG names" if file else "the environment"
        raise UsageError(f"{where}: {'; '.join(error.problems)}") from None
    return address_of(config, endpoint, robot_id, tls)


def require_id(robot_id: str) -> None:
    """Raise `UsageError` if `robot_id` does not have the form of a robot's id."""
    try:
        convert(robot_id, Name)
    except ValidationError:
        raise UsageError(
            f"{robot_id!r} is not a robot's id: an id has 1 to 32 characters of A-Z a-z 0-9 _ -; "
            "the id must equal robot.id in the robot's acsard.toml"
        ) from None
