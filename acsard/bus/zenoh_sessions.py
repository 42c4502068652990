"""Opens the Zenoh sessions of the daemon, of the TLS gateway and of the client tools.

All settings of these sessions are here, each with its reason. Functions import modules that only
they need: `acsard call stop` starts in half of the time without those of the daemon.
"""

from __future__ import annotations

import errno
import json
import os
import re
import time
from pathlib import Path

import zenoh

from acsard.bus.tls_files import CA, CERTIFICATE, KEY, files_in, host_and_port, require_usable
from acsard.bus.tls_trouble import RENEW_ADVICE, trouble
from acsard.core.codes import joined
from acsard.core.config.settings import TLS_PREFIX, Config, is_tls
from acsard.core.messages.keys_and_roles import IMU, SPEED_LIMIT, STOP, full_key, source_keys
from acsard.host import clock
from acsard.host.errors import (
    CertificateError,
    InUseError,
    MendableError,
    UnreachableError,
    UsageError,
)

# Per key. It lets a zero 1 ms after another command pass, and a flood costs no control period. The
# gateway may drop a stop, but it has passed one less than 1 ms before.
COMMAND_RATE_HZ = 1000.0

MAX_SESSIONS = 256  # connections

# For an address of this computer that DHCP may bring later. A service that failed at once would use
# up its restarts.
ADDRESS_WAIT_S, ADDRESS_RETRY_S = 8.0, 0.5

MAX_MESSAGE_BYTES = 65536  # commands have a far lower limit


def daemon_session(config: Config) -> zenoh.Session:
    """Open the daemon's session: a Zenoh peer or client without multicast discovery.

    It blocks in client mode until the router answers. Raises `InUseError` if it cannot listen,
    `CertificateError` if Zenoh refuses the files for a TLS router, and `MendableError`.
    """
    from acsard.bus.access_rules import access_control

    bus = config.bus
    settings = _base(bus.mode) | {
        "listen/endpoints": list(bus.plain),
        "connect/endpoints": list(bus.connect),
        # Peers behind a router find each other only through gossip. Without a router the daemon has
        # no peers.
        "scouting/gossip/enabled": bool(bus.connect),
        "timestamping/enabled": True,
        "queries_default_timeout": 3000,
        "access_control": access_control(config),
        "downsampling": [_command_limits(config)],
    }
    settings |= _listening()
    if bus.tls_routers:
        # With files that Zenoh refuses, the session would open, and never reach the router.
        require_accepted(*files_in(bus.tls))
        settings |= _tls(bus.tls)
    if bus.connect:
        settings |= RETRY_SETTINGS
    if bus.mode == "peer":
        return _opened(settings, bus.plain)
    try:
        return zenoh.open(_config(settings))
    except zenoh.ZError as error:
        raise MendableError(
            f"cannot open the Zenoh session to {', '.join(bus.connect)}: {first_line(error)}; "
            "check bus.connect, then start acsard again"
        ) from error


def gateway_session(config: Config) -> zenoh.Session:
    """Open the session of the TLS gateway, a Zenoh router.

    Raises `CertificateError` if Zenoh refuses the files, and `InUseError` if it cannot listen.
    """
    from acsard.bus.access_rules import gateway_access
    from acsard.core.ros.transports import stop_keys

    bus = config.bus
    settings = _base("router") | RETRY_SETTINGS | _tls(bus.tls) | _listening()
    # Limit only PUT messages. Otherwise a flood of DELETE messages, which are not stops, would use
    # up the limit of the stops. The daemon's own session does not limit stops.
    stops = _rate_limit("stops", ["put"], [full_key(config.robot.id, STOP), *stop_keys(config.ros)])
    settings |= {
        "access_control": gateway_access(config),
        "downsampling": [_command_limits(config), stops],
        "listen/endpoints": list(bus.outside),
        "connect/endpoints": [reachable(bus.plain[0])],
        "scouting/gossip/enabled": False,
        # The gateway must not stamp samples. Otherwise the daemon would take the gateway for the
        # sender of these samples.
        "timestamping/enabled": False,
    }
    try:
        return _opened(settings, bus.outside)
    except InUseError:
        # Zenoh's error is of the same type for an address in use and for files that it refuses.
        require_accepted(*files_in(bus.tls))
        raise


def require_accepted(authority: Path, certificate: Path, key: Path) -> None:
    """Raise `CertificateError` if Zenoh cannot listen with these files."""
    why = certificate_trouble(authority, certificate, key)
    if why:
        raise CertificateError(
            f"{certificate} with the key {key} cannot be used: OpenSSL "
            f"accepts these files, but Zenoh does not ({why}); to make files that Zenoh accepts, "
            f"{RENEW_ADVICE}"
        ) from None


def certificate_trouble(authority: Path, certificate: Path, key: Path) -> str:
    """Return why Zenoh cannot listen with these files, or ""; this takes some milliseconds.

    OpenSSL accepts some that Zenoh refuses: X.509 version 1 (without extensions), and keys of the
    curves P-521 and Ed448.
    """
    files = {
        "root_ca_certificate": str(authority),
        "listen_certificate": str(certificate),
        "listen_private_key": str(key),
        "enable_mtls": True,
    }
    # A session in the mode "router" would take half a second to open.
    settings = _base("peer") | {
        "listen/endpoints": [f"{TLS_PREFIX}127.0.0.1:0"],
        "transport/link/tls": files,
    }
    try:
        zenoh.open(_config(settings)).close()
    except zenoh.ZError as error:
        # The rest of the text is about the endpoint above, which the operator does not know.
        return first_line(error).rpartition("unexpected error: ")[2]
    return ""


def reachable(endpoint: str) -> str:
    """Return where a program on this machine reaches what listens at `endpoint`.

    All addresses (0.0.0.0 or [::]) become the loopback address.
    """
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def no_endpoint(text: str) -> UsageError:
    """Return the error for a `text` that is no Zenoh endpoint, which says how to write one."""
    lack = ", because its port is missing" if _lacks_port(text) else ""
    return UsageError(f'{text} is not an endpoint{lack}; write it like "tcp/127.0.0.1:7448"')


def _lacks_port(endpoint: str) -> bool:
    return endpoint.startswith(("tcp/", TLS_PREFIX)) and not re.search(r":\d+(?=$|[?#])", endpoint)


def answers(endpoint: str) -> bool:
    """Return whether a program accepts TCP connections at `endpoint`. Raises `UsageError`."""
    import socket

    host, port = host_and_port(reachable(endpoint))
    if not (host and port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise no_endpoint(endpoint)
    try:
        socket.create_connection((host, int(port)), timeout=1.0).close()
    except UnicodeError:  # the host has an empty or too long part
        raise no_endpoint(endpoint) from None
    except OSError:
        return False
    return True


# Try until it succeeds.
RETRY_SETTINGS = {"connect/timeout_ms": -1, "connect/exit_on_failure": False}


def _listening() -> dict[str, object]:
    # Against clients that send nothing, send too much, or do not read.
    return {
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        "transport/unicast/accept_timeout": 1000,
        # With a limit of 32 pending connections, 300 idle connections keep an operator out for 2 s.
        # With a limit of 512, they do not. 512 pending connections take 3 MB.
        "transport/unicast/accept_pending": 512,
        "transport/unicast/max_sessions": MAX_SESSIONS,
        # Zenoh's default. A session announces its lease, and the other side closes the link if it
        # receives nothing for that time. If a daemon has stood still for longer than the lease of
        # the gateway or of a router, it closes the link without reading the stop that waits in its
        # socket. With a lease of 2 s, a stop was lost after 1.9 s.
        "transport/link/tx/lease": 10_000,
        # A subscriber that does not read must not delay a put. By default, each put waits 1 ms.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 50_000,
    }


def _opened(settings: dict[str, object], where: tuple[str, ...]) -> zenoh.Session:
    until_s = clock.steady_s() + ADDRESS_WAIT_S
    while True:
        try:
            return zenoh.open(_config(settings))
        except zenoh.ZError as error:
            reason = first_line(error)
            number = re.search(r"\(os error (\d+)\)", reason)
            code = int(number[1]) if number else 0
            if code != errno.EADDRNOTAVAIL:
                advice = (
                    "if another daemon or router uses the address, stop that program, or choose "
                    "another address with --listen or in bus.listen"
                )
            elif clock.steady_s() < until_s:
                time.sleep(ADDRESS_RETRY_S)
                continue
            else:
                advice = (
                    "this computer does not have one of these addresses (`hostname -I` prints its "
                    "own): connect its network, or correct bus.listen"
                )
            reason = os.strerror(code) if code else reason
            text = f"cannot listen on {', '.join(where)}: {reason}; {advice}"
            raise InUseError(text) from error


def client_session(endpoint: str, tls: str = "") -> zenoh.Session:
    """Open a session in client mode, because a peer reaches no program behind a router.

    Only a TLS endpoint needs `tls`, the directory of the client's certificate. Raises `UsageError`,
    `NotPermittedError`, `CertificateError` or `UnreachableError`.
    """
    if "/" not in endpoint or _lacks_port(endpoint):
        raise no_endpoint(endpoint)
    settings = _base("client") | {
        "connect/endpoints": [endpoint],
        # A server that accepts a connection and then sends nothing is not a daemon. The limit is
        # short, because a person waits.
        "transport/unicast/open_timeout": 3000,
        "timestamping/enabled": True,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 50_000,
    }
    secured = is_tls(endpoint)
    if secured:
        if not tls:
            raise CertificateError(
                f"{endpoint} requires a certificate: add --tls DIRECTORY (tls= in Python), the "
                "directory that `acsard tls init` or `acsard tls add` made for you"
            )
        # For an unusable certificate Zenoh would report the same error as for an absent daemon.
        require_usable(tls)
        settings |= _tls(tls)
    try:
        return zenoh.open(_config(settings))
    except zenoh.ZError:
        why = None
        if secured:
            require_accepted(*files_in(tls))
            why = trouble(endpoint, tls)
        # The message leaves out Zenoh's own error, which names Zenoh's source files.
        text = (
            "start it there: `acsard run`. If it runs, its bus.listen needs this address, and it "
            f"serves {MAX_SESSIONS} clients at most"
            if why is None
            else joined(why).text
        )
        raise UnreachableError(f"no daemon answers at {endpoint}: {text}", why) from None


def _base(mode: str) -> dict[str, object]:
    return {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        # Zenoh accepts the retry settings only together. With the defaults the daemon would
        # reconnect only seconds after a router comes back.
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 500,
            "period_increase_factor": 1.5,
        },
    }


def _tls(directory: str) -> dict[str, object]:
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


def _command_limits(config: Config) -> dict[str, object]:
    # Zenoh counts for each connection. There, the keys of all certificates of a source share one
    # limit, and so do the keys of all unconfigured sources.
    from acsard.core.ros.transports import command_keys

    names = [*(source.name for source in config.commands.sources), "*"]
    below = [*source_keys(names), *source_keys(names, "*"), IMU, SPEED_LIMIT]
    keys = [full_key(config.robot.id, key) for key in below]
    return _rate_limit("commands", ["put", "delete"], [*keys, *command_keys(config.ros)])


def _rate_limit(name: str, messages: list[str], keys: list[str]) -> dict[str, object]:
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
    """Return the first line of Zenoh's error text, without the paths of its source files."""
    text = re.sub(r"(?: at)? /\S+\.rs:\d+\.?", "", str(error)).splitlines()
    return text[0][:200].strip() if text else type(error).__name__


def log_from_environment() -> None:
    """Start Zenoh's own log on standard output if RUST_LOG is set."""
    if "RUST_LOG" in os.environ:
        zenoh.try_init_log_from_env()
