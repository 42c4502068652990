"""Ask the robot for the role of this client: viewer, operator or maintainer. Over TLS the
certificate decides; on the robot's own machine every client is maintainer. If no daemon answers,
the exit code is 69. Over TLS it is 77, because the daemon also does not answer a client whose
certificate has no role.
"""

from __future__ import annotations

import argparse

import msgspec

from acsard.cli.connection import add_bus, connected
from acsard.core.formatting import json_line
from acsard.host.errors import Exit


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print it as JSON")
    add_bus(parser)


def main(args: argparse.Namespace) -> int:
    with connected(args) as robot:
        us = robot.whoami()
    if args.json:
        print(json_line(msgspec.json.encode(us).decode()))
    else:
        print(f"{us.describe()}\nsender {us.sender}")
    if us.role:
        return Exit.OK
    return Exit.NO_PERMISSION if us.certificate else Exit.UNREACHABLE
