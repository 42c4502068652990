"""`acsard get KEY`: what a key answers now, as JSON."""

from __future__ import annotations

import argparse
import sys

from acsard.cli.common import MANY, add_bus, require_asked, robots_address


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "get",
        help="ask a key once and print its answer as JSON",
        description="Ask a key and print its answer as JSON, laid out for a terminal and on one "
        "line into a pipe: info, config, interfaces, topics, schema/Twist, and the last value of "
        "any key that is published.",
    )
    parser.add_argument("key", help="for example info, config, schema/Twist, state")
    add_bus(parser, MANY)
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Ask and print."""
    import msgspec

    from acsard.bus.fleet import present
    from acsard.cli.echo import json_line, of_robot
    from acsard.client import connect

    require_asked(args.key)
    (endpoint, robot_id, tls), many = robots_address(args)
    with connect(endpoint, robot_id=robot_id, tls=tls) as robot:
        if not many:
            found = [json_line(*robot.reply(args.key))]
        else:
            ids = present(robot.session, many, endpoint)
            answers = ((one, robot.like(one).reply(args.key)) for one in ids)
            found = [of_robot(one, json_line(*answer)) for one, answer in answers]
    for line in found:
        shown = msgspec.json.format(line, indent=2) if sys.stdout.isatty() else line
        print(shown)
    return 0
