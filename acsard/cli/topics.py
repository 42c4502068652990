"""`acsard topics`: the table of keys."""

from __future__ import annotations

import argparse

from acsard.cli.common import add_config, load


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "topics",
        help="list the keys on the bus: direction, type, rate, meaning",
        description="List every key of the daemon. Needs no running daemon.",
    )
    add_config(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Print the table."""
    from acsard.messages.encodings import encode
    from acsard.messages.queries import topic_table

    _, config = load(args.config)
    table = topic_table(config.robot.id)
    if args.json:
        print(encode(table, "json").decode())
        return 0
    rows = [("KEY", "", "TYPE", "RATE", "MEANING")]
    rows += [(t.key, t.direction, t.type, t.rate, t.note) for t in table.topics]
    widths = [max(len(row[i]) for row in rows) for i in range(4)]
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=False)]
        print("  ".join([*cells, row[4]]).rstrip())
    return 0
