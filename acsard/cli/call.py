"""`acsard call <service>`: stop, clear, activate, …"""

from __future__ import annotations

import argparse

from acsard.cli.common import add_bus, robot_address
from acsard.messages.topics import SERVICES

CALLED = tuple(service for service in SERVICES if service != "set")
"""`acsard set` calls that one, and knows what can be set."""


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "call",
        help="call a service: " + ", ".join(CALLED),
        description="Call a service and print its answer; exit 1 when it was refused.",
    )
    parser.add_argument("service", choices=CALLED, metavar="SERVICE", help=", ".join(CALLED))
    parser.add_argument(
        "values", nargs="*", type=float, metavar="X Y YAW", help="for set_pose: m, m, rad"
    )
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")
    add_bus(parser)
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Call and print."""
    from acsard.client import connect
    from acsard.host.errors import UsageError
    from acsard.messages.encodings import encode

    wanted = ("x", "y", "yaw") if args.service == "set_pose" else ()
    if len(args.values) != len(wanted):
        form = " ".join(["acsard call", args.service, *(name.upper() for name in wanted)])
        raise UsageError(f"write: {form}")
    endpoint, robot_id, tls = robot_address(args)
    with connect(endpoint, robot_id=robot_id, tls=tls) as robot:
        reply = robot.call(args.service, **dict(zip(wanted, args.values, strict=True)))
    print(encode(reply, "json").decode() if args.json else reply.message)
    return 0 if reply.success else 1
