"""`acsard fleet`: show one live line per robot."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from acsard.cli.common import MANY, add_bus, robots_address
from acsard.host.errors import Exit, ExitError

if TYPE_CHECKING:
    from acsard.client import Client
    from acsard.top.fleet import Fleet
    from acsard.top.roster import Row

GATHER_S = 1.5
"""Time within which every robot that is present has answered, s."""

NOBODY_S = 3.0
"""Time before the tool reports that no robot is there, s.

On a busy computer the first answer arrives late.
"""


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb and its options."""
    parser = verbs.add_parser(
        "fleet",
        help="show one live line per robot",
        description="Show mode, speed, link, version and reason of every robot that the bus or "
        "router at --connect knows, live; q or Ctrl-C quits. Over TLS a role may "
        "use only exact keys, so name the robots: --id robot1,robot2. Into a pipe, "
        "or with --once, the tool prints one table.",
    )
    parser.add_argument("--once", action="store_true", help="print one table and end")
    add_bus(parser, MANY + " (the default)")
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Show the robots until the operator leaves, or print one table."""
    from acsard.client import connect
    from acsard.daemon.bus.robot_discovery import ALL
    from acsard.terminal.output import has_screen
    from acsard.top import terminal
    from acsard.top.fleet import Fleet

    (endpoint, robot_id, tls), many = robots_address(args)
    ids = (many or (robot_id,)) if args.id else (ALL,)
    with connect(endpoint, robot_id=robot_id, tls=tls) as robot:
        fleet = Fleet(robot, ids, endpoint)
        if args.once or not has_screen():
            return _once(fleet, robot.like(ids[0]) if tls and ids != (ALL,) else None)
        terminal.roster(fleet)
    return int(Exit.OK)


def _once(fleet: Fleet, asked: Client | None) -> int:
    """Print one table. Raises `ExitError` with code 69 if no robot is present.

    Args:
        fleet: the robots that are followed.
        asked: a client that asks, if no robot is present, whether our certificate may see any; None
            without TLS.
    """
    from acsard.top.roster import table

    began, rows = time.monotonic(), fleet.rows()
    while not fleet.whole and time.monotonic() - began < (GATHER_S if _any(rows) else NOBODY_S):
        time.sleep(0.05)
        rows = fleet.rows()
    rows = fleet.rows()
    if not _any(rows):
        silence = "" if asked is None else asked.whoami().silence
        raise ExitError(Exit.UNREACHABLE, "; ".join(filter(None, (fleet.hint(), silence))))
    width = shutil.get_terminal_size((160, 24)).columns
    # Flush now: nothing that delays our exit may hold back the table.
    print("\n".join(table(rows, width)), flush=True)
    for told in filter(None, (fleet.seen, fleet.more)):
        print(f"acsard: {told}", file=sys.stderr)
    return int(Exit.OK)


def _any(rows: Sequence[Row]) -> bool:
    return any(row.here or row.state for row in rows)
