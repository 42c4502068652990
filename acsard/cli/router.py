"""Run Zenoh in router mode with a configuration file of Zenoh, such as deploy/zenoh/router.json5,
until a signal. The router loads no plugins of Zenoh; if you need storages, use zenohd instead.
"""

from __future__ import annotations

import argparse
import signal
from pathlib import Path

from acsard.bus.fleet_router import open_router
from acsard.bus.zenoh_sessions import log_from_environment
from acsard.core.config.settings import LogConfig
from acsard.host.child import end_signals
from acsard.host.errors import Exit
from acsard.host.logs import Log


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
