"""Call a service of the robot, such as stop or clear, and print the robot's answer. The exit code
is 1 if the robot refuses.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence

from acsard.bus import robot_discovery
from acsard.cli.replies import of_each, print_each
from acsard.cli.robot_options import SEVERAL_IDS, add_bus, connected_to_many, several_ids
from acsard.client.connection import Connection
from acsard.core.formatting import json_line, lines, printable
from acsard.core.messages.encodings import encode
from acsard.core.messages.keys_and_roles import SERVICES
from acsard.core.messages.schema import MESSAGES, ServiceReply
from acsard.host.errors import UsageError

# The service `set` is `acsard set`.
CALLABLE_SERVICES = tuple(service for service in SERVICES if service != "set")

RELEASES = tuple(service for service, row in SERVICES.items() if row.payload == "Release")


class _Known(tuple[str, ...]):
    # For the completion of the shell. Any word is accepted, because the daemon may have others.
    def __contains__(self, word: object) -> bool:
        return True


def add_options(parser: argparse.ArgumentParser) -> None:
    needed = {service: " ".join(_needed(service)) for service in CALLABLE_SERVICES}
    forms = [f"{service} {names.upper()}" for service, names in needed.items() if names]
    parser.add_argument(
        "service",
        # Accept `srv/stop` too, because the table of keys contains the name in this form.
        type=lambda word: word.removeprefix("srv/"),
        choices=_Known(CALLABLE_SERVICES),
        metavar="SERVICE",
        help=", ".join(CALLABLE_SERVICES),
    )
    parser.add_argument(
        "values",
        nargs="*",
        type=_number,
        metavar="NUMBER",
        help=f"the numbers that the service needs: {'; '.join(forms)}. For {' and '.join(RELEASES)}"
        ": the causes to release, by `causes` in `acsard get state` (default: all that are older "
        "than the call)",
    )
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")
    add_bus(parser, SEVERAL_IDS + " (stop only)")


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        words = f"{text} is not a number; `acsard call --help` lists what each service needs"
        raise argparse.ArgumentTypeError(words) from None


def main(args: argparse.Namespace) -> int:
    if args.service == "set":
        raise UsageError("a setting is changed with `acsard set KEY VALUE`")
    fields = _causes(args.values) if args.service in RELEASES else _fields(args)
    if args.service != "stop" and several_ids(args):
        raise UsageError(
            f"only stop can be called on several robots at once: before {args.service}, a person "
            "must look at each robot. Name one robot in --id; `acsard fleet` lists the ids"
        )
    with connected_to_many(args) as (robot, many):
        if many:
            return _stop_all(robot, many, as_json=args.json)
        reply = robot.call(args.service, **fields)
    text = lines(reply.message)
    print(json_line(encode(reply, "json").decode()) if args.json else text)
    return 0 if reply.success else 1


def _causes(values: Sequence[float]) -> dict[str, object]:
    # Without numbers, the client names the causes that are older than the call.
    for value in values:
        if not (0 <= value < 1 << 53 and value.is_integer()):
            raise UsageError(
                f"{value:g} is not the number of a cause: `acsard get state` lists them in `causes`"
            )
    return {"numbers": [int(value) for value in values]} if values else {}


def _needed(service: str) -> tuple[str, ...]:
    # The daemon refuses a service that it does not have. It may have one that is unknown here.
    row = SERVICES.get(service)  # type: ignore[call-overload]
    needs = row is not None and row.payload and not row.optional
    return MESSAGES[row.payload].__struct_fields__ if needs else ()


def _fields(args: argparse.Namespace) -> dict[str, object]:
    names, values = _needed(args.service), args.values
    if len(values) != len(names):
        form = " ".join(["acsard call", args.service, *map(str.upper, names)])
        raise UsageError(f"wrong number of arguments; type: {form}")
    for name, value in zip(names, values, strict=True):
        if not math.isfinite(value):
            raise UsageError(f"{name.upper()} = {value}: the number must be finite; correct it")
    return dict(zip(names, values, strict=True))


def _stop_all(robot: Connection, ids: tuple[str, ...], *, as_json: bool) -> int:
    # First stop every named robot without waiting for answers. `of_each` may first look up which
    # robots are present, which would delay the stop.
    robot_discovery.stop(robot.session, ids, robot.caller)
    replies = of_each(robot, ids, lambda client: client.call("stop"))
    silence = "NO ANSWER: go to the robot, or use its emergency switch"
    code = print_each(replies, robot, ids, silence, as_json=as_json)
    moving = [
        name
        for name, reply in replies.items()
        if not (isinstance(reply, ServiceReply) and reply.success)
    ]
    if moving:
        advice = "go to them; repeat the stop until every line says `stopped`"
        print(f"acsard: NOT STOPPED: {printable(', '.join(moving))}: {advice}", file=sys.stderr)
    return code
