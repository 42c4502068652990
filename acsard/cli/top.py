"""`acsard top`: show the robot live on one screen."""

from __future__ import annotations

import argparse

from acsard.cli.common import add_bus, robot_address


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb and its options."""
    parser = verbs.add_parser(
        "top",
        help="show the robot's status on one screen, live",
        description="Show mode, pose, wheels, command sources, link and timing on one screen, "
        "live; q or Ctrl-C quits. Into a pipe, or with --once, the tool prints one "
        "screen as plain text.",
    )
    parser.add_argument("--once", action="store_true", help="print one screen and end")
    add_bus(parser)
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Show the robot until the operator leaves, or print one screen."""
    from acsard.client import connect
    from acsard.terminal.output import has_screen
    from acsard.top import terminal
    from acsard.top.feed import Feed

    endpoint, robot_id, tls = robot_address(args)
    with connect(endpoint, robot_id=robot_id, tls=tls) as robot:
        feed = Feed(robot, endpoint, robot_id)
        if args.once or not has_screen():
            print(terminal.once(feed))
        else:
            terminal.live(feed)
    return 0
