"""Print each message on a key as one line of JSON, until Ctrl-C. Every key below the robot's id
works, for example `cmd/teleop`. --short prints pose, speeds and warnings as text, for example:
acsard echo odom -n 1 --short. If --id names several robots, each line names its robot, and -n N
prints N messages of each robot.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Collection, Iterator
from typing import Any

import zenoh

from acsard.bus.robot_discovery import ALL_ROBOTS, follow, robot_of, running_robots
from acsard.bus.subscription import encoded
from acsard.cli.common import whole
from acsard.cli.replies import json_line, of_robot
from acsard.cli.robot_options import (
    SEVERAL_IDS,
    Silence,
    add_bus,
    connected_to_many,
    require_readable,
)
from acsard.client.connection import Connection
from acsard.core import formatting
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.keys_and_roles import TOPICS, by_key
from acsard.core.messages.schema import MESSAGES
from acsard.core.messages.short_texts import SHORT_TEXTS, short
from acsard.host.errors import Exit, NoAnswerError, UsageError


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "topic", help="Zenoh key, for example odom, state, wheel_states, cmd/teleop"
    )
    parser.add_argument(
        "--short",
        action="store_true",
        help="print one line of text per message (only for odom, state, cmd_vel_out and sim/pose)",
    )
    parser.add_argument(
        "-n",
        type=whole("messages", 999_999_999),
        metavar="N",
        help="end after N messages of each robot",
    )
    add_bus(parser, SEVERAL_IDS)


def main(args: argparse.Namespace) -> int:
    topic = args.topic
    short_form = _shortened(topic) if args.short else None
    require_readable(topic, "echo")
    with connected_to_many(args) as (robot, many):
        silence, robots = Silence(robot, topic), None
        if many:
            silence, robots = Silence(robot, ""), _expected(robot, many)
            subscription = follow(robot.session, many, topic)
            samples = subscription.until_silence(None, silence.look)
        else:
            samples = robot.samples(topic, silence.look)
            if robot.where.tls and (why := robot.whoami().silence):
                print(f"acsard: {why}. Waiting.", file=sys.stderr)
                silence.heard()  # the reason for the silence has just been printed
        return _print(samples, short_form, args.n, robots, silence)


def _print(
    samples: Iterator[zenoh.Sample],
    decoder: Decoder[Any] | None,
    most: int | None,
    robots: Collection[str] | None,
    silence: Silence,
) -> int:
    # Until Ctrl-C, `most` messages of each robot, or the end of the connection. `robots` is None if
    # there is one.
    counts = Counter[str]()
    try:
        for sample in samples:
            silence.heard()
            whose = "" if robots is None else robot_of(str(sample.key_expr))
            if counts[whose] != most:
                counts[whose] += 1
                print(_message_text(decoder, *encoded(sample), whose), flush=True)
            if all(counts[robot] == most for robot in robots or counts):
                return Exit.OK
    except KeyboardInterrupt:
        return Exit.OK
    silence.explain()
    return Exit.FAILURE


def _shortened(key: str) -> Decoder[Any]:
    kinds = {kind.__name__: kind for kind in SHORT_TEXTS}
    topic = by_key(key)
    if topic is None or topic.type not in kinds:
        known = ", ".join(entry.key for entry in TOPICS if entry.type in kinds)
        raise UsageError(f"{key} has no short form, only JSON; these keys have one: {known}")
    return Decoder(MESSAGES[topic.type])


def _message_text(decoder: Decoder[Any] | None, encoding: str, payload: bytes, whose: str) -> str:
    if decoder is not None:
        try:
            text = short(decoder.decode(encoding, payload))
        except DecodeError:
            pass
        else:
            return formatting.printable(f"{whose}: {text}" if whose else text)
    line = json_line(encoding, payload)
    return of_robot(whose, line) if whose else formatting.json_line(line)


def _expected(robot: Connection, ids: tuple[str, ...]) -> Collection[str]:
    # Also prints which robots are present.
    # Without the printed text, the operator could not distinguish a silent robot from an absent
    # robot.
    there: list[str] = []
    try:
        there = running_robots(robot.session, ids, robot.where.endpoint)
        missing = [robot_id for robot_id in ids if robot_id not in there and robot_id != ALL_ROBOTS]
        words = f"following {', '.join(there) or 'no robot yet'}"
        words += f"; not present: {', '.join(missing)}" if missing else ""
    except NoAnswerError as error:
        words = f"{error} Waiting."
    print(f"acsard: {words}", file=sys.stderr)
    return there if ALL_ROBOTS in ids else ids
