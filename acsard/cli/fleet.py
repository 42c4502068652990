"""Show a live table of every robot on the bus or router at --connect: mode, speed, link, place,
version and reason. Press q or Ctrl-C to quit. Over TLS a role may use only exact keys, so name the
robots: --id robot1,robot2. Into a pipe, or with --once, the tool prints one table. PLACE gives x
and y in m and the heading. VERSION marks a number as older if another robot in the table has a
higher one. SEEN gives the age of the last report. WHY gives the warnings, then the
reason why the robot moves or does not move, then the details of the warnings. A robot that is ready
can have warnings too: a certificate that expires soon, a recording or a latch file that fails, a
wheel fault. A robot that --id or `[fleet] robots` names is always listed, and the exit code is 69
if it is gone or does not answer. On a narrow terminal some columns are left out and long lines are
cut; `acsard fleet | cat` prints everything.
"""

from __future__ import annotations

import argparse
import shutil
import sys

import msgspec

from acsard.bus.robot_discovery import ALL_ROBOTS
from acsard.cli.robot_options import SEVERAL_IDS, add_bus, connected_to_many
from acsard.core.formatting import json_line
from acsard.host.errors import Exit, UnreachableError
from acsard.host.logs import MAX_LAST_OUTPUT_S, output_in_threads
from acsard.terminal.output import UNLIMITED_WIDTH, has_screen, plain
from acsard.top import terminal
from acsard.top.fleet_table import table
from acsard.top.roster import Roster, absence


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--once", action="store_true", help="print one table and end")
    parser.add_argument(
        "--json",
        action="store_true",
        help="print one JSON list with the whole `state` of each robot, and end",
    )
    add_bus(parser, SEVERAL_IDS, usual=f"'{ALL_ROBOTS}'")


def main(args: argparse.Namespace) -> int:
    args.id = args.id or ALL_ROBOTS
    with connected_to_many(args) as (robot, many):
        ids = many or (robot.where.robot_id,)
        fleet = Roster(robot, ids)
        if not (args.once or args.json) and has_screen():
            with output_in_threads(MAX_LAST_OUTPUT_S):
                terminal.roster(fleet)
            return Exit.OK
        rows = fleet.gather()
        if args.json:
            print(json_line(msgspec.json.encode(rows).decode()), flush=True)
        elif rows:
            width = shutil.get_terminal_size().columns if sys.stdout.isatty() else UNLIMITED_WIDTH
            # Flush now, so that a session that closes slowly does not hold back the table.
            print(plain(table(rows, width), width=width), flush=True)
        if not any(row.here or row.state for row in rows):
            # Over TLS the client's certificate may not be permitted to see any of the named robots.
            tls = rows and robot.where.tls
            silence = robot.sibling(rows[0].robot_id).whoami().silence if tls else ""
            raise UnreachableError("; ".join(filter(None, (fleet.hint(), silence))))
    lost = [row.robot_id for row in rows if row.robot_id in ids and absence(row)]
    lost_text = f"gone or silent: {', '.join(lost)}" if lost else ""
    for text in filter(None, ("" if args.json else fleet.presence_text, lost_text)):
        print(f"acsard: {text}", file=sys.stderr)
    return Exit.UNREACHABLE if lost else Exit.OK
