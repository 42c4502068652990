"""`acsard doctor`: find what is wrong on this machine and how to fix it."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from typing import TYPE_CHECKING

from acsard.cli.common import add_bus, by_environment, require_one
from acsard.host.config_file import find
from acsard.host.terminal_modes import coloured

if TYPE_CHECKING:
    from acsard.doctor.finding import Finding


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb and its options."""
    parser = verbs.add_parser(
        "doctor",
        help="find out what is wrong on this machine",
        description="Look at the configuration, the serial port and who holds it, permissions, "
        "clock, real-time limits, certificates, and the daemon if it runs: where the "
        "configuration has it, or where the options say, as it was started. Each finding comes "
        "with its mend. Exit 0 when nothing fails, 1 when something does.",
    )
    add_bus(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Examine the machine and print the findings. Return 1 if any of them is a failure."""
    import msgspec

    from acsard.bus.address import address_of
    from acsard.doctor.examination import examine

    require_one(args)
    told = partial(address_of, connect=args.connect, robot_id=args.id, tls=args.tls)
    findings = list(examine(*find(args.config), by_environment(), told))
    if args.json:
        print(msgspec.json.encode(findings).decode())
    else:
        colours = coloured(sys.stdout)
        for finding in findings:
            print(line(finding, colours))
    return 1 if any(finding.level == "failure" for finding in findings) else 0


def line(finding: Finding, colours: bool) -> str:
    """Return a finding as text for a terminal, with its fix on a second line."""
    mark = {"ok": "ok  ", "warning": "warn", "failure": "FAIL"}[finding.level]
    if colours:
        mark = f"\033[{ {'ok': 32, 'warning': 33, 'failure': 31}[finding.level] }m{mark}\033[0m"
    text = f"{mark}  {finding.subject}: {finding.text}"
    return f"{text}\n      -> {finding.mend}" if finding.mend else text
