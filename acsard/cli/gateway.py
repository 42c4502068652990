"""Listen at the tls/ endpoints of bus.listen and pass on to the daemon only the messages that each
client's certificate allows. `acsard run` starts this gateway by itself; its systemd service is
acsard-gateway.service. If the gateway ends with exit code 1, start it again.
"""

from __future__ import annotations

import argparse
import os
import sys

from acsard.bus.zenoh_sessions import log_from_environment
from acsard.cli.common import add_config, load
from acsard.daemon.gateway.gateway_process import GatewayProcess
from acsard.daemon.gateway.tls_gateway import Gateway
from acsard.host.errors import UsageError
from acsard.host.logs import Log
from acsard.host.systemd import Systemd


def add_options(parser: argparse.ArgumentParser) -> None:
    add_config(parser)
    parser.add_argument("--id", metavar="ID", help="the robot's id on the bus")
    parser.add_argument("--namespace", metavar="NAME", help="the robot's ROS namespace")
    parser.add_argument(
        "--supervised",
        action="store_true",
        help="end when standard input closes; `acsard run` uses this",
    )


def main(args: argparse.Namespace) -> int:
    overrides = {"robot.id": args.id or None, "ros.namespace": args.namespace}
    where, config = load(args.config, overrides)
    manager = Systemd(os.environ, os.getpid())
    if not config.bus.outside:
        manager.ready()  # the unit takes this end for no failure, if it had started
        raise UsageError(
            f"{where} has no tls/ endpoint in bus.listen: `acsard tls init --write FILE` adds one",
        )
    log_from_environment()
    log = Log(config.log)
    try:
        holder = sys.stdin.fileno() if args.supervised else None
        return GatewayProcess(Gateway(config), log, manager, holder).run()
    finally:
        manager.close()
        log.close()
