"""Run Zenoh in router mode with a configuration file of Zenoh, such as deploy/zenoh/router.json5,
until a signal. The router loads no plugins of Zenoh; if you need storages, use zenohd instead.
"""

from __future__ import annotations

import argparse
import json
import re
import signal
from pathlib import Path
from typing import Any

import zenoh

from acsard.bus.tls_files import require_usable_files
from acsard.bus.zenoh_sessions import first_line, log_from_environment, require_accepted
from acsard.core.config.settings import LogConfig
from acsard.host.child import end_signals
from acsard.host.errors import Exit, ExitError, MendableError
from acsard.host.logs import Log

# Zenoh's errors about a wrong key or value, and about text that is not JSON5.
_VALUE_ERROR = re.compile(
    r'msg: "((?:[^"\\]|\\.)*)", location: Some\(Location \{ line: (\d+), column: (\d+) \}\)'
)

CERTIFICATE_FILES = ("root_ca_certificate", "listen_certificate", "listen_private_key")

_SYNTAX_ERROR = re.compile(
    r"--> (\d+):(\d+)\n.*^ *= ([^\n]*?)(?: at /\S+\.rs:\d+\.?)?$", re.M | re.S
)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file", type=Path, metavar="FILE", help="Zenoh's configuration file (JSON5)"
    )


def main(args: argparse.Namespace) -> int:
    # Zenoh's threads inherit the blocked signals, so `sigwait` gets each of them.
    signal.pthread_sigmask(signal.SIG_BLOCK, end_signals())
    log_from_environment()
    log = Log(LogConfig())
    try:
        session, where = open_router(args.file)
        log.info("router_open", text=f"listens at {where}")
        signal.sigwait(end_signals())
        session.close()
    finally:
        log.close()
    return Exit.OK


def open_router(file: Path) -> tuple[zenoh.Session, str]:
    """Open the router, and return its session and the addresses at which it listens.

    Raises `ExitError` if the file cannot be read or is not a router's configuration,
    `CertificateError` or `NotPermittedError` for its certificate files, and `MendableError` if
    Zenoh cannot open the router, for example because an address is in use.
    """
    try:
        # Read the file here, because Zenoh's error would not say why the file cannot be opened.
        file.read_bytes()
    except OSError as error:
        raise ExitError(
            Exit.BAD_CONFIG,
            f"cannot read {file}: {error.strerror}; name a file that this user may read",
        ) from None
    try:
        config = zenoh.Config.from_file(str(file))
        mode, endpoints = _setting(config, "mode"), _setting(config, "listen/endpoints")
        config.insert_json5("plugins_loading/enabled", "false")
    except zenoh.ZError as error:
        raise ExitError(
            Exit.BAD_CONFIG, f"{file} is not a Zenoh configuration: {_reason(error)}; correct it"
        ) from error
    # A file without endpoints gets Zenoh's default, a dict: every address, without encryption.
    if mode != "router" or not endpoints or isinstance(endpoints, dict):
        raise ExitError(
            Exit.BAD_CONFIG,
            f'{file} is not the configuration of a router: it needs mode: "router" and '
            'listen: { endpoints: ["tls/..."] }',
        )
    tls, where = _setting(config, "transport/link/tls"), ", ".join(endpoints)
    names = [tls[name] for name in CERTIFICATE_FILES]
    files = [Path(name) for name in names if name]
    has_files = len(files) == len(CERTIFICATE_FILES)
    if has_files:
        require_usable_files(*files)
    try:
        return zenoh.open(config), where
    except zenoh.ZError as error:
        if has_files:
            require_accepted(*files)
        raise MendableError(
            f"cannot open the router of {file} at {where}: {_reason(error)}; end the program that "
            "uses the address, or correct the file"
        ) from error


def _setting(config: zenoh.Config, key: str) -> Any:
    return json.loads(config.get_json(key))


def _reason(error: zenoh.ZError) -> str:
    text = str(error)
    if match := _VALUE_ERROR.search(text):
        message = re.sub(r"\\(.)", r"\1", match[1])
        return f"line {match[2]}, column {match[3]}: {message}"
    if match := _SYNTAX_ERROR.search(text):
        return f"line {match[1]}, column {match[2]}: {match[3]}"
    return first_line(error)
