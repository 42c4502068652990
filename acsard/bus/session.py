"""Zenoh sessions as acsard opens them: the daemon's, the door's, and the tools' clients.

What lives here: the session settings with the reason for each. What must not: keys or messages.
"""

from __future__ import annotations

import json
import os
import re
import sys

import zenoh

from acsard.bus.certificates import CA, CERTIFICATE, KEY, require_usable
from acsard.bus.tls_trouble import trouble
from acsard.config.settings import TLS, BusConfig
from acsard.host.colours import coloured
from acsard.host.errors import CertificateError, InUseError, UnreachableError, UsageError
from acsard.messages.topics import full_key, source_keys

COMMAND_RATE_HZ = 1000.0
"""Commands let in per key: enough for a zero 1 ms after a command, too few to cost a period. The
door lets in as many stops: one that is left out says the same as that of the millisecond before."""

MAX_SESSIONS = 256
"""Clients at once, at the machine and at the door each; idle connections of strangers must not
keep a person out for long."""

MESSAGE_BYTES = 65536
"""Largest message taken from a link; commands are held to far less in code."""


def daemon_session(
    bus: BusConfig,
    robot_id: str,
    sources: tuple[str, ...],
    limited: tuple[str, ...],
    access: dict[str, object],
) -> zenoh.Session:
    """The daemon's session: a peer that listens where it is told, finds nobody by itself.

    `limited` are the ROS keys commands come in on, `access` is who may do what. Who comes by TLS
    comes through the door. Raises `InUseError` when the address is taken. Blocks, as a client until
    its router is there; call it in a thread.
    """
    settings = _base(bus.mode) | {
        "listen/endpoints": list(bus.plain),
        "connect/endpoints": list(bus.connect),
        # Peers behind a router find each other by gossip only; without a router there is nobody.
        "scouting/gossip/enabled": bool(bus.connect),
        "timestamping/enabled": True,
        "queries_default_timeout": 3000,
    }
    settings |= _listening() | _limits(robot_id, sources, limited, access)
    if any(endpoint.startswith(TLS) for endpoint in bus.connect):
        settings |= _tls(bus.tls)
    if bus.connect:
        settings |= PATIENT
    return _opened(settings, bus.plain)


def door_session(
    bus: BusConfig,
    robot_id: str,
    sources: tuple[str, ...],
    limited: tuple[str, ...],
    access: dict[str, object],
) -> zenoh.Session:
    """The door's session: a router between the network, by TLS, and the daemon on this machine."""
    settings = _base("router") | PATIENT | _tls(bus.tls) | _listening()
    # No DELETE on their key, which is none, may keep a stop out. At the daemon none is limited.
    stops = _at_most("stops", ["put"], [full_key(robot_id, "stop")])
    settings |= _limits(robot_id, sources, limited, access, stops)
    settings |= {
        "listen/endpoints": list(bus.outside),
        "connect/endpoints": [reachable(bus.plain[0])],
        "scouting/gossip/enabled": False,
        # Who does not stamp must not seem to: the daemon would take the door for the sender.
        "timestamping/enabled": False,
    }
    return _opened(settings, bus.outside)


def reachable(endpoint: str) -> str:
    """Where somebody on this machine reaches what listens on every address."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def no_endpoint(text: str) -> UsageError:
    """What to raise for it."""
    return UsageError(f'{text} is not an endpoint; write it like "tcp/127.0.0.1:7448"')


PATIENT = {"connect/timeout_ms": -1, "connect/exit_on_failure": False}


def _listening() -> dict[str, object]:
    """Strangers who connect and say nothing, or too much."""
    return {
        "transport/link/rx/max_message_size": MESSAGE_BYTES,
        "transport/unicast/accept_timeout": 1000,
        # With 32, 300 idle connections keep a person out for 2 s; so many cost 3 MB then.
        "transport/unicast/accept_pending": 512,
        "transport/unicast/max_sessions": MAX_SESSIONS,
        "transport/link/tx/lease": 2000,
        # A stopped subscriber must not hold a put: by default each waits 1 ms for room.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 50_000,
    }


def _limits(
    robot_id: str,
    sources: tuple[str, ...],
    limited: tuple[str, ...],
    access: dict[str, object],
    *more: dict[str, object],
) -> dict[str, object]:
    """Who may do what, and how often."""
    limits = [_command_limits(robot_id, sources, limited), *more]
    return {"access_control": access, "downsampling": limits}


def _opened(settings: dict[str, object], where: tuple[str, ...]) -> zenoh.Session:
    try:
        return zenoh.open(_config(settings))
    except zenoh.ZError as error:
        raise InUseError(
            f"cannot listen on {', '.join(where)}: {first_line(error)}; another daemon or router "
            "may have it: stop that, or give this one an address of its own, by --listen or in "
            "bus.listen",
        ) from error


def client_session(endpoint: str, tls: str = "") -> zenoh.Session:
    """A client of the daemon (or a router) at `endpoint`; a peer behind one would reach no other.

    `tls` is the directory with the certificates for an endpoint like "tls/robot.local:7449".
    Raises `UsageError` for what is no endpoint, `NotPermittedError` and `CertificateError` for the
    certificates, and `UnreachableError` when nobody answers there.
    """
    if "/" not in endpoint:
        raise no_endpoint(endpoint)
    settings = _base("client") | {
        "connect/endpoints": [endpoint],
        # What accepts and then says nothing is no daemon; a person waits for this.
        "transport/unicast/open_timeout": 3000,
        "timestamping/enabled": True,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 50_000,
    }
    secured = endpoint.startswith(TLS)
    if secured and not tls:
        raise CertificateError(
            f"{endpoint} wants a certificate: add --tls DIRECTORY (tls= in Python), the directory "
            "that `acsard lan init` or `lan add` made for you"
        )
    if secured:
        require_usable(tls)  # Zenoh says of them what it says of a daemon that is not there
        settings |= _tls(tls)
    try:
        return zenoh.open(_config(settings))
    except zenoh.ZError as error:
        seen = trouble(endpoint, tls) if secured else ""
        raise UnreachableError(
            f"no daemon answers at {endpoint}: "
            + (
                seen
                or f"is `acsard run` running, is this its bus.listen, has it room (at most "
                f"{MAX_SESSIONS} connections)? ({first_line(error)})"
            )
        ) from None  # its own words are those of its source files


def _base(mode: str) -> dict[str, object]:
    return {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        # Its parts cannot be set alone. Without it a router that comes back waits seconds for us.
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 500,
            "period_increase_factor": 1.5,
        },
    }


def _tls(directory: str) -> dict[str, object]:
    """Both ends show a certificate of the same CA, and a link ends with its certificate."""
    certificate, key = f"{directory}/{CERTIFICATE}", f"{directory}/{KEY}"
    return {
        "transport/link/tls": {
            "root_ca_certificate": f"{directory}/{CA}",
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
            "enable_mtls": True,
            "close_link_on_expiration": True,
        }
    }


def _command_limits(
    robot_id: str, sources: tuple[str, ...], limited: tuple[str, ...]
) -> dict[str, object]:
    """A limit per listed source, so that none uses up another's; one more for all unlisted.

    The certificates of a source share a limit, but each connection has limits of its own.
    """
    listed = [*sources, "*"]
    below = [*source_keys(listed), *source_keys(listed, "*"), "imu"]
    keys = [full_key(robot_id, key) for key in below]
    return _at_most("commands", ["put", "delete"], [*keys, *limited])


def _at_most(name: str, messages: list[str], keys: list[str]) -> dict[str, object]:
    return {
        "id": name,
        "messages": messages,
        "flows": ["ingress"],
        "rules": [{"key_expr": key, "freq": COMMAND_RATE_HZ} for key in keys],
    }


def _config(settings: dict[str, object]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def first_line(error: Exception) -> str:
    """What a Zenoh error says, without the source paths it carries."""
    text = re.sub(r"(?: at)? /\S+\.rs:\d+\.?", "", str(error)).splitlines()
    return text[0][:200].strip() if text else type(error).__name__


def log_from_environment() -> None:
    """Zenoh's own log, only when RUST_LOG asks for it: it goes to standard output."""
    if "RUST_LOG" not in os.environ:
        return
    wish = os.environ.get("NO_COLOR")
    if not coloured(sys.stdout):  # it looks at this alone, and colours pipes and files
        os.environ["NO_COLOR"] = "1"
    zenoh.try_init_log_from_env()
    if wish is None:
        os.environ.pop("NO_COLOR", None)
    else:
        os.environ["NO_COLOR"] = wish
