"""Run Zenoh in router mode with a configuration file of Zenoh, such as deploy/zenoh/router.json5.
The router is a child process. It is killed and restarted if a client takes all of the router's
processor time or memory. It loads no plugins of Zenoh; if you need storages, use zenohd instead.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
from pathlib import Path

from acsard.bus.zenoh_sessions import log_from_environment
from acsard.core.config.settings import LogConfig
from acsard.daemon.gateway.fleet_router import Router
from acsard.daemon.gateway.listener_process import ListenerProcess
from acsard.daemon.supervisor import ROUTER, keep_running
from acsard.host.child import end_signals
from acsard.host.logs import Log
from acsard.host.systemd import Systemd


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file", type=Path, metavar="FILE", help="Zenoh's configuration file (JSON5)"
    )
    # The subcommand starts itself as a child process with this option. The child process is the
    # router. It ends when its standard input is closed.
    parser.add_argument("--supervised", action="store_true", help=argparse.SUPPRESS)


def main(args: argparse.Namespace) -> int:
    router, log = Router(args.file), Log(LogConfig())
    try:
        if not args.supervised:
            return asyncio.run(_keep_router(str(args.file), log))
        log_from_environment()
        manager = Systemd({}, os.getpid())
        return ListenerProcess(router, log, manager, sys.stdin.fileno()).run()
    finally:
        log.close()


async def _keep_router(file: str, log: Log) -> int:
    """Run a router process, and restart it whenever it ends. Return 0 after a signal.

    If the router cannot use its configuration or its certificates, return its exit code.
    """
    keeper = asyncio.ensure_future(keep_running(["router", file], log.event, ROUTER))
    for number in end_signals():
        asyncio.get_running_loop().add_signal_handler(number, keeper.cancel)
    try:
        return await keeper
    except asyncio.CancelledError:
        # A signal must end this process. The router process has been released already.
        return 0
