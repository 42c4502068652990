"""List every key of the daemon. The daemon does not need to run."""

from __future__ import annotations

import argparse

from acsard.cli.common import add_config, load
from acsard.core.config.settings import Config
from acsard.core.incoming.queries import topic_table
from acsard.core.messages.encodings import encode
from acsard.core.messages.keys_and_roles import COMMANDS, by_key, source_keys
from acsard.core.messages.schema import TopicInfo, Topics
from acsard.core.ros.names import full_name
from acsard.core.ros.parameters import SETTING_SERVICES
from acsard.core.ros.transports import ros_names, unused_keys
from acsard.terminal.output import show, table


def add_options(parser: argparse.ArgumentParser) -> None:
    add_config(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--ros", action="store_true", help="list the ROS 2 names instead")


def main(args: argparse.Namespace) -> int:
    _, config = load(args.config)
    topics = ros_table(config) if args.ros else topic_table(config)
    if args.json:
        print(encode(topics, "json").decode())
        return 0
    rows = [(t.key, t.direction, t.type, t.rate, t.note) for t in topics.topics]
    show(table(rows, ("KEY", "", "TYPE", "RATE", "MEANING")))
    return 0


def ros_table(config: Config) -> Topics:
    """Return the enabled ROS topics and services; a topic's note names its Zenoh key."""
    ros = config.ros
    known = source_keys(source.name for source in config.commands.sources)
    rows = []
    for row in ros_names(unused_keys(config)) if ros.bridge or ros.rmw else ():
        native = by_key(row.native)
        note = f"as {row.native}" + (f": {native.note}" if native else "")
        if row.direction == "query":
            sets = row.name.endswith(SETTING_SERVICES)
            note = (
                "changes the settings that `acsard set` lists"
                if sets
                else "reads the configuration as ROS parameters"
            )
        elif row.native.partition("/")[0] in COMMANDS and row.native not in known:
            note += ": refused, because no [[commands.sources]] has this name"
        name = full_name(ros.namespace, row.name)
        rows.append(TopicInfo(name, row.direction, row.type, native.rate if native else "", note))
    return Topics(rows)
