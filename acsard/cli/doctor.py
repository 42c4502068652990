"""Print the diagnostics of the running daemon, each problem with its fix. Print also what only a
program on this computer sees: the configuration file, the serial port and the program that uses it,
permissions, the clock, real-time limits, reasons why programs run late, and certificates. The tool
looks for the daemon at the address in the options, else in the configuration. The exit code is 1 if
a check fails, else 0.
"""

from __future__ import annotations

import argparse
from functools import partial

import msgspec
from rich.text import Text

from acsard.bus.address import address_of
from acsard.cli.common import add_port, overrides
from acsard.cli.robot_options import add_bus, require_one
from acsard.core.formatting import json_line, lines, printable
from acsard.host.config_file import find
from acsard.machine.examination import examine
from acsard.terminal.output import show_whole

LEVEL_MARKS = {"ok": ("ok  ", "green"), "warning": ("warn", "yellow"), "failure": ("FAIL", "red")}


def add_options(parser: argparse.ArgumentParser) -> None:
    add_bus(parser)
    add_port(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def main(args: argparse.Namespace) -> int:
    require_one(args)
    find_address = partial(address_of, connect=args.connect, robot_id=args.id, tls=args.tls)
    findings = list(examine(*find(args.config), overrides({"mcu.port": args.port}), find_address))
    if args.json:
        print(json_line(msgspec.json.encode(findings).decode()))
    else:
        for finding in findings:
            mend = f"\n      -> {lines(finding.mend)}" if finding.mend else ""
            text = f"  {finding.subject}: {printable(finding.text)}{mend}"
            show_whole(Text.assemble(LEVEL_MARKS[finding.level], text))
    return 1 if any(finding.level == "failure" for finding in findings) else 0
