"""Drive the robot with the keyboard of this terminal. The tool uses the full screen."""

from __future__ import annotations

import argparse
import sys
from contextlib import suppress

from acsard.cli.common import add_speeds
from acsard.cli.robot_options import add_bus, connected, require_one
from acsard.client.connection import Connection
from acsard.core.messages.permissions import COMMAND_ROLE, has
from acsard.host.errors import MendableError, NoAnswerError, NotPermittedError, UsageError
from acsard.host.logs import MAX_LAST_OUTPUT_S, output_in_threads
from acsard.terminal.output import has_screen
from acsard.top import terminal
from acsard.top.drive_screen import HELP, velocity
from acsard.top.keyboard import Keyboard, KeyboardDrive


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "\n".join(HELP)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    add_speeds(parser, 0.5, 1.0, 0.0, "speed at the start, which keys change during the drive")
    add_bus(parser)


def main(args: argparse.Namespace) -> int:
    require_one(args)
    if not sys.stdin.isatty() or not has_screen():
        raise UsageError(
            "acsard drive reads single key presses and uses the full screen, so run it in a "
            "terminal (with another TERM than dumb); a program must use acsard.client instead"
        )
    with output_in_threads(MAX_LAST_OUTPUT_S), connected(args, "teleop") as robot:
        if robot.where.tls and not has((us := robot.whoami()).role, COMMAND_ROLE):
            raise (NotPermittedError if us.role else NoAnswerError)(us.describe())
        ride = KeyboardDrive(robot, Keyboard(args.linear, args.angular), _limits(robot))
        try:
            terminal.drive(ride)
        finally:
            ride.end()
        terminal.print_last_report(ride)
    return 0


def _limits(robot: Connection) -> str:
    # Over TLS only a maintainer may read them.
    with suppress(MendableError):
        limits = robot.get("config")["limits"]
        return velocity(limits["linear_speed"], limits["angular_speed"])
    return ""
