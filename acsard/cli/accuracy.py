"""Observe the robot while someone drives it. For each cause of odometry errors, print the error
that it alone would produce if the drive continued like this: mm after 100 m, and degrees after a
turn of 360 degrees. The causes are the timing and the rounding of the feedback lines, times without
feedback lines, slip, wheel radii, track width, and the gyro if there is one. The tool also says how
to reduce the largest error. It sends no commands. While the robot stands still, the tool prints
only the errors that follow from the settings.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import suppress

import msgspec

from acsard.calibration.error_budget.budget import Budget
from acsard.calibration.error_budget.budget_report import advice, parts
from acsard.calibration.error_budget.daemon_messages import budgets
from acsard.cli.common import load, seconds
from acsard.cli.connection import add_bus, connected
from acsard.client import Client
from acsard.core.config.settings import Config
from acsard.host.errors import Exit, NoAnswerError, NotPermittedError
from acsard.terminal.output import MAX_TEXT_WIDTH, show


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seconds",
        type=seconds,
        default=5.0,
        metavar="S",
        help="duration of the measurement in seconds (default: 5)",
    )
    parser.add_argument(
        "--follow",
        action="store_true",
        help="run until Ctrl-C and print a result every S seconds (see --seconds). Each result "
        "covers the time since the start, but at most the last 60000 feedback lines (ten minutes "
        "at 100 Hz)",
    )
    parser.add_argument("--json", action="store_true", help="print each result as a line of JSON")
    add_bus(parser)


def main(args: argparse.Namespace) -> int:
    with connected(args) as robot, suppress(KeyboardInterrupt):
        for budget in budgets(robot, _config(robot, args.config), args.seconds):
            _print(budget, args.json)
            if not args.follow:
                break
    return Exit.OK


def _config(robot: Client, path: str | None) -> Config:
    try:
        return msgspec.convert(robot.get("config"), Config)
    except (NoAnswerError, NotPermittedError, msgspec.ValidationError):
        where, config = load(path)
        print(
            f"acsard: the robot did not send its configuration. Using {where} instead",
            file=sys.stderr,
        )
        return config


def _print(budget: Budget, as_json: bool) -> None:
    if not as_json:
        show(*parts(budget), most=MAX_TEXT_WIDTH)
        return
    millimetres, degrees = budget.total()
    fields = msgspec.to_builtins(budget)
    fields |= {"mm_per_100_m": millimetres, "deg_per_turn": degrees, "advice": advice(budget)}
    print(msgspec.json.encode(fields).decode(), flush=True)
