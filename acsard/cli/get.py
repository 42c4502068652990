"""Query a key and print the answer as JSON, indented on a terminal and as one line into a pipe. The
key is info, config, interfaces, topics, schema/Twist or any published key. The answer of a
published key is its last message. If --id names several robots, each line has the answer of one
robot. The exit code is 69 if a robot does not answer.
"""

from __future__ import annotations

import argparse
import sys

import msgspec

from acsard.cli.replies import json_line, of_robot, present_ids
from acsard.cli.robot_options import SEVERAL_IDS, add_bus, connected_to_many, require_readable
from acsard.core import formatting
from acsard.core.formatting import printable
from acsard.core.values import AcsardError
from acsard.host.errors import Exit


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("key", help="Zenoh key, for example info, config, schema/Twist, state")
    add_bus(parser, SEVERAL_IDS)


def main(args: argparse.Namespace) -> int:
    require_readable(args.key, "get")
    with connected_to_many(args) as (robot, many):
        if not many:
            _show(json_line(*robot.reply(args.key)))
            return 0
        silent = 0
        for robot_id in present_ids(robot, many):
            try:
                line = json_line(*robot.sibling(robot_id).reply(args.key))
            except AcsardError as error:
                silent += 1
                print(printable(f"{robot_id}: NO ANSWER: {error}"), file=sys.stderr)
                continue
            _show(of_robot(robot_id, line))
    return Exit.UNREACHABLE if silent else Exit.OK


def _show(line: str) -> None:
    text = msgspec.json.format(line, indent=2) if sys.stdout.isatty() else line
    print(formatting.json_line(text))
