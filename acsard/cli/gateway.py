"""`acsard gateway`: the TLS gateway, a separate process that admits clients of other machines."""

from __future__ import annotations

import argparse
import sys

from acsard.cli.common import add_config, load
from acsard.host.errors import Exit, ExitError


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb and its options."""
    parser = verbs.add_parser(
        "gateway",
        help="run the TLS gateway, which admits clients of other machines",
        description="Listen at the tls/ endpoints of bus.listen and hand on to the daemon what the "
        "certificates allow. `acsard run` starts one by itself; as a service it is "
        "acsard-gateway.service. Ends with 1 when it has to be opened anew.",
    )
    add_config(parser)
    parser.add_argument("--id", metavar="ID", help="the robot's id on the bus")
    parser.add_argument("--namespace", metavar="NAME", help="its namespace in ROS")
    parser.add_argument(
        "--supervised",
        action="store_true",
        help="end when standard input ends, as below `acsard run`",
    )
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Run the gateway until a signal ends it or until it must be restarted."""
    import os

    from acsard.daemon.bus.zenoh_sessions import log_from_environment
    from acsard.daemon.gateway.supervision import Watched
    from acsard.daemon.gateway.tls_gateway import Gateway
    from acsard.host.logs import Log
    from acsard.host.systemd import Systemd

    given: dict[str, dict[str, object]] = {"robot": {"id": args.id}} if args.id else {}
    if args.namespace is not None:
        given["ros"] = {"namespace": args.namespace}
    where, config = load(args.config, given)
    if not config.bus.outside:
        raise ExitError(
            Exit.USAGE, f"{where} has no tls/ endpoint in bus.listen; `acsard tls init --write`"
        )
    log_from_environment()
    log, manager = Log(config.log), Systemd(os.environ, os.getpid())
    try:
        holder = sys.stdin.fileno() if args.supervised else None
        code = Watched(Gateway(config), log, manager, holder).run()
    finally:
        manager.close()
        log.close()
    return int(code)
