"""`acsard router`: the router of a fleet, which notices when somebody holds it up."""

from __future__ import annotations

import argparse
import asyncio
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from acsard.host.logs import Log


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "router",
        help="a fleet's Zenoh router, watched and opened anew when it is held up",
        description="Zenoh in router mode by a configuration of Zenoh's own, such as "
        "deploy/zenoh/router.json5, in a process that is ended and started again when somebody "
        "connected takes all its time or memory. Without plugins: storages are zenohd's.",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="Zenoh's configuration (JSON5)")
    # So it starts itself: be the router, and end with standard input.
    parser.add_argument("--held", action="store_true", help=argparse.SUPPRESS)
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Route until a signal."""
    import os

    from acsard.bus.session import log_from_environment
    from acsard.config.settings import LogConfig
    from acsard.door.router import Router
    from acsard.door.watched import Watched
    from acsard.host.logs import Log
    from acsard.host.systemd import Systemd

    router, log = Router(args.file), Log(LogConfig())
    try:
        if not args.held:
            asyncio.run(_kept(str(args.file), log))
            return 0
        log_from_environment()
        manager = Systemd({}, os.getpid())
        return int(Watched(router, log, manager, sys.stdin.fileno()).run())
    finally:
        log.close()


async def _kept(file: str, log: Log) -> None:
    """One router after the other, until a signal."""
    import signal

    from acsard.runtime.doorkeeper import keep_door

    keeper = asyncio.ensure_future(keep_door(["router", file], log.event, "the router"))
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, keeper.cancel)
    try:
        await keeper
    except asyncio.CancelledError:
        pass  # asked to go; the process below has been let go of
