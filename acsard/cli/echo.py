"""Print each message on a key as one line of JSON, until Ctrl-C. Every key below the robot's id
works, for example `cmd/teleop`. --short prints pose, speeds and warnings as text, for example:
acsard echo odom -n 1 --short. --rate prints each second the message rate, and the times from one
message to the next. If --id names several robots, each line names its robot, and -n N prints N
messages of each robot.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections import Counter, deque
from collections.abc import Collection, Iterator
from itertools import pairwise
from statistics import fmean, pstdev, quantiles
from typing import Any

import zenoh

from acsard.bus.robot_discovery import ALL_ROBOTS, follow, robot_of, running_robots
from acsard.bus.subscription import encoded
from acsard.cli.common import between, whole
from acsard.cli.replies import json_line, of_robot
from acsard.cli.robot_options import (
    SEVERAL_IDS,
    Silence,
    add_bus,
    connected,
    connected_to_many,
    require_readable,
    several_ids,
)
from acsard.client.connection import Connection
from acsard.core import formatting
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.keys_and_roles import TOPICS, by_key
from acsard.core.messages.schema import MESSAGES
from acsard.core.messages.short_texts import SHORT_TEXTS, short
from acsard.host.errors import Exit, NoAnswerError, UsageError

RATE_SPAN_S = 10.0  # of the messages that a line of `--rate` describes


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "topic", help="Zenoh key, for example odom, state, wheel_states, cmd/teleop"
    )
    form = parser.add_mutually_exclusive_group()
    form.add_argument(
        "--short",
        action="store_true",
        help="print one line of text per message (only for odom, state, cmd_vel_out and sim/pose)",
    )
    form.add_argument(
        "--rate",
        action="store_true",
        help="print one line per second about the messages of the last 10 s: their rate, and the "
        "shortest, median, 99 %% and longest time between two of them",
    )
    parser.add_argument(
        "-n",
        type=whole("messages", 999_999_999),
        metavar="N",
        help="end after N messages of each robot; with --rate, after N lines",
    )
    parser.add_argument(
        "--timeout",
        type=between(0.01, 86400, "seconds"),
        metavar="S",
        help="end with exit code 1 if nothing is printed for S seconds (0.01 to 86400)",
    )
    add_bus(parser, SEVERAL_IDS)


def main(args: argparse.Namespace) -> int:
    topic = args.topic
    if args.rate and several_ids(args):
        raise UsageError("with --rate, name one robot in --id")
    short_form = _shortened(topic) if args.short else None
    require_readable(topic, "echo")
    if args.rate:
        with connected(args) as robot:
            return _print_rates(robot, topic, args.n)
    with connected_to_many(args) as (robot, many):
        silence, robots = Silence(robot, topic), None
        if many:
            silence, robots = Silence(robot, ""), _expected(robot, many)
            subscription = follow(robot.session, many, topic)
            samples = subscription.until_silence(args.timeout, silence.look)
        else:
            samples = robot.samples(topic, args.timeout, silence.look)
            if robot.where.tls and (why := robot.whoami().silence):
                print(f"acsard: {why}. Waiting.", file=sys.stderr)
                silence.heard()  # the reason for the silence has just been printed
        return _print(samples, short_form, args.n, robots, args.timeout, silence)


def _print(
    samples: Iterator[zenoh.Sample],
    decoder: Decoder[Any] | None,
    most: int | None,
    robots: Collection[str] | None,
    timeout: float | None,
    silence: Silence,
) -> int:
    # Until Ctrl-C, `most` messages of each robot, or a silence. `robots` is None for one robot.
    counts, printed_s = Counter[str](), time.monotonic()
    try:
        for sample in samples:
            silence.heard()
            whose = "" if robots is None else robot_of(str(sample.key_expr))
            if counts[whose] != most:
                counts[whose] += 1
                print(_message_text(decoder, *encoded(sample), whose), flush=True)
                printed_s = time.monotonic()
            elif timeout is not None and time.monotonic() - printed_s > timeout:
                return Exit.FAILURE
            if all(counts[robot] == most for robot in robots or counts):
                return Exit.OK
    except KeyboardInterrupt:
        return Exit.OK
    silence.explain()
    return Exit.FAILURE


def _print_rates(robot: Connection, topic: str, most: int | None) -> int:
    # Python receives fewer than a million messages in `RATE_SPAN_S`. So the limit takes effect only
    # while the output is blocked.
    times: deque[float] = deque(maxlen=1_000_000)
    silence, heard_s = Silence(robot, topic), time.monotonic()
    subscriber = robot.listen(topic, lambda _: times.append(time.monotonic()))
    try:
        for _ in itertools.count() if most is None else range(most):
            time.sleep(1.0)
            if times and times[-1] > heard_s:
                heard_s = times[-1]
                silence.heard()
            silence.look(time.monotonic() - heard_s)
            while times and time.monotonic() - times[0] > RATE_SPAN_S:
                times.popleft()
            print(rate_text(list(times)), flush=True)
    except KeyboardInterrupt:
        pass
    subscriber.undeclare()
    return Exit.OK


def rate_text(times: list[float]) -> str:
    """Return the rate of messages with these arrivals, s, and the gaps between them."""
    if len(times) < 2 or times[-1] <= times[0]:
        return "no messages yet" if not times else f"{len(times)} messages, no rate yet"
    gaps_ms = [1e3 * (after - before) for before, after in pairwise(times)]
    # `quantiles` needs two values.
    values = gaps_ms if len(gaps_ms) > 1 else gaps_ms * 2
    percentiles = quantiles(values, n=100, method="inclusive")
    return (
        f"{1e3 / fmean(gaps_ms):8.2f} Hz   gaps ms: min {min(gaps_ms):.2f}  "
        f"p50 {percentiles[49]:.2f}  p99 {percentiles[98]:.2f}  "
        f"max {max(gaps_ms):.2f}  std {pstdev(gaps_ms):.2f}   n {len(times)}"
    )


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
