"""`acsard whoami`: show the role that this bus gives us, and the certificate it goes by."""

from __future__ import annotations

import argparse

from acsard.cli.common import add_bus, robot_address
from acsard.host.errors import Exit


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb and its options."""
    parser = verbs.add_parser(
        "whoami",
        help="show your role on this robot, your certificate and your sender id",
        description="Ask the robot for the role of this client: viewer, operator or maintainer. "
        "Over TLS the certificate decides; on the robot's own machine every client "
        "is maintainer. The exit code is 77 if the client has no role.",
    )
    parser.add_argument("--json", action="store_true", help="print it as JSON")
    add_bus(parser)
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Ask the robot for our role and print it. Return `NO_PERMISSION` without a role."""
    import msgspec

    from acsard.client import connect

    endpoint, robot_id, tls = robot_address(args)
    with connect(endpoint, robot_id=robot_id, tls=tls) as robot:
        us = robot.whoami()
    if args.json:
        print(msgspec.json.encode(us).decode())
    else:
        print(f"{us.words()}\nsender {us.sender}")
    return int(Exit.OK if us.role else Exit.NO_PERMISSION)
