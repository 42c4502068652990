"""Show mode, pose, wheels, command sources, link and timing live on one screen. Press q or Ctrl-C
to quit. Into a pipe, or with --once, the tool prints one screen as plain text.
"""

from __future__ import annotations

import argparse

from acsard.cli.robot_options import add_bus, connected
from acsard.host.logs import MAX_LAST_OUTPUT_S, output_in_threads
from acsard.terminal.output import has_screen
from acsard.top import terminal
from acsard.top.feed import Feed


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--once", action="store_true", help="print one screen and end")
    add_bus(parser)


def main(args: argparse.Namespace) -> int:
    with connected(args) as robot:
        feed = Feed(robot)
        if args.once or not has_screen():
            print(terminal.one_screen(feed))
        else:
            with output_in_threads(MAX_LAST_OUTPUT_S):
                terminal.show_live(feed)
    return 0
