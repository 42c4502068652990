"""Shared code of the subcommands that use the bus.

It consists of their options, their connection to robots, checks of the typed key, and explanations
why no message arrives.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from threading import Event, Thread

import zenoh

from acsard.bus.address import Address, address_of
from acsard.bus.robot_discovery import Presence, explain_silence, parse_ids, presence
from acsard.bus.tls import trouble
from acsard.cli.common import add_config, load
from acsard.client import Client, connect
from acsard.client.follower import FIRST_STATE_TIMEOUT_S
from acsard.core.config.settings import TLS_PREFIX
from acsard.core.formatting import printable
from acsard.core.messages.keys_and_roles import key_hint, row_of, unknown
from acsard.host.errors import UsageError

SEVERAL_IDS = "; several ids separated by commas, or '*' for all robots"


def add_bus(parser: argparse.ArgumentParser, more: str = "") -> None:
    """Add the options that select a robot and the address of its daemon.

    `more` is appended to the help text of `--id`.
    """
    add_config(parser)
    parser.add_argument(
        "--connect", metavar="ENDPOINT", help="address of the daemon, e.g. tcp/127.0.0.1:7448"
    )
    parser.add_argument(
        "--tls",
        metavar="DIRECTORY",
        help="directory with your certificate, for a tls/ endpoint (default: $ACSARD_TLS, or "
        "bus.tls)",
    )
    parser.add_argument("--id", metavar="ID", help="the robot's id (default: robot.id)" + more)


@contextmanager
def connected(args: argparse.Namespace, source: str = "app") -> Iterator[Client]:
    """Connect to the one robot that the options name, and yield a client of this robot.

    The client sends commands as the command source `source`. Raises `UsageError` if `--id` names
    several robots.
    """
    endpoint, robot_id, tls = robot_address(args)
    with connect(endpoint, robot_id=robot_id, source=source, tls=tls) as robot:
        yield robot


def robot_address(args: argparse.Namespace) -> Address:
    """Return the address of the robot that the options name.

    Without these options, return the address of the configured robot. Raises `UsageError` if
    `--id` names several robots.
    """
    require_one(args)
    _, config = load(args.config)
    return address_of(config, args.connect, args.id, args.tls)


def several_ids(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the ids in `--id` if it names several robots, ("*",) for all robots, otherwise ()."""
    return parse_ids(args.id or "")


def require_one(args: argparse.Namespace) -> None:
    """Raise `UsageError` if `--id` names several robots."""
    if several_ids(args):
        raise UsageError(
            f"--id '{args.id}' names several robots, but `acsard {args.verb}` takes one: "
            "`acsard fleet` lists the robots; only echo, get, set, fleet and call stop take several"
        )


@contextmanager
def connected_to_many(args: argparse.Namespace) -> Iterator[tuple[Client, tuple[str, ...]]]:
    """Connect to the bus, and yield a pair: a client, and the ids of the robots to use.

    If `--id` names one robot, the client is for this robot, and the tuple of ids is empty. Without
    `--id`, the client is for the configured robot. If `--id` names several robots, the tuple
    contains their ids, or only "*" for `--id '*'`. Then use `Client.sibling` to get a client of
    one of these robots.
    """
    many = several_ids(args)
    _, config = load(args.config)
    where = address_of(config, args.connect, None if many else args.id, args.tls)
    with connect(where.endpoint, robot_id=where.robot_id, tls=where.tls) as robot:
        yield robot, many


def require_followed(key: str) -> None:
    """Raise `UsageError` if `key` is a known key on which no messages are published.

    The text of the error contains the command to type instead. If `key` is unknown, print a
    warning, because a misspelt key would otherwise look like a robot that sends nothing.
    """
    if unknown(key):
        words = f"{key} is not in the topic table ({key_hint(key)}); waiting for messages anyway"
        print(f"acsard: {printable(words)}", file=sys.stderr)
    row = row_of(key)
    if row is None:
        return
    instead = {
        "query": f"has no messages and only answers queries: type acsard get {key}",
        "service": f"is a service without messages: type acsard call {key.removeprefix('srv/')}",
    }.get(row.direction)
    if row.key == "alive":
        instead = (
            "is a Zenoh liveliness token without messages: acsard fleet lists the robots that are "
            "present"
        )
    if instead is not None:
        raise UsageError(f"the key {key} {instead}")


def require_asked(key: str) -> None:
    """Raise `UsageError` if `acsard get` cannot query this key.

    `get` refuses a key that does not answer queries, and a key with a wildcard, because it prints
    only one answer. It also refuses the key of a service, because a query on this key would call
    the service.
    """
    if set(key.partition("?")[0]) & set("*$"):
        raise UsageError(
            f"{key} stands for several keys, but get queries only one; `acsard topics` lists them"
        )
    row = row_of(key)
    if row is None:
        return
    if row.direction == "service":
        raise UsageError(f"{key} is a service: type acsard call {key.removeprefix('srv/')}")
    if row.direction == "in":
        raise UsageError(
            f"{key} is an input and does not answer queries: type acsard echo {key} to print the "
            "messages that arrive on it"
        )
    if row.key == "alive":
        raise UsageError(
            "the key alive is a Zenoh liveliness token and does not answer queries: acsard fleet "
            "lists the robots that are present"
        )


@contextmanager
def explained(
    look: Callable[[], str],
    ceased: Callable[[], str] | None = None,
    after_s: float = FIRST_STATE_TIMEOUT_S,
    timeout_s: float = math.inf,
) -> Iterator[Callable[[], None]]:
    """Print the reason if the `with` block receives no messages.

    Yield a function, which the block must call for each message. A separate thread finds the reason
    and prints it on standard error, so the block can go on receiving.

    Args:
        look: function that returns why no message has arrived yet, or "" to print nothing. It is
            called once if no message arrives in the first `after_s` s.
        ceased: function for a later silence. It returns why no further message arrives, or "" to
            print nothing. It is called each `after_s` s of the silence, until it has returned a
            reason. If `ceased` is None, no reason for a later silence is printed.
        after_s: time without a message after which a reason is printed, s.
        timeout_s: time without a message after which the block ends by itself, s. If no message
            has arrived by then, the reason is printed before the block is left.
    """
    come, end, looked = Event(), Event(), Event()
    began_s = time.monotonic()

    def print_reason(reason: str) -> bool:
        if reason and not come.is_set():
            print(f"acsard: {printable(reason)}", file=sys.stderr, flush=True)
        return bool(reason)

    def print_reasons() -> None:
        try:
            reported = not come.wait(min(after_s, timeout_s)) and print_reason(look())
        finally:
            looked.set()
        while ceased is not None and not end.wait(after_s):
            if come.is_set():
                come.clear()
                reported = False
            elif not reported:
                reported = print_reason(ceased())

    Thread(target=print_reasons, name="waiting", daemon=True).start()
    try:
        yield come.set
        if time.monotonic() - began_s >= timeout_s:
            looked.wait()
    finally:
        end.set()
        come.set()


def silence_explained(
    robot: Client, key: str, timeout_s: float | None = None
) -> AbstractContextManager[Callable[[], None]]:
    """Return a context that prints why no message arrives on a key, or that the connection is lost.

    The context yields a function, which the caller must call for each message. Texts go to standard
    error. If `key` is "", only a lost connection is reported. If no message arrives for `timeout_s`
    s, the caller leaves the context; None means no time limit. If no message has arrived at all by
    then, the reason is printed before the context ends.
    """
    return explained(
        lambda: _none_yet(robot, key) if key else "",
        lambda: _ceased(robot),
        timeout_s=math.inf if timeout_s is None else timeout_s,
    )


def _none_yet(robot: Client, key: str) -> str:
    where = robot.where
    status = presence(robot.session, where.robot_id, where.endpoint)
    if status is None:
        return ""
    reason = "" if status.linked else _of_link(where)
    reason = reason or explain_silence(key, where.robot_id, where.endpoint, status)
    return f"waiting for messages on {robot.key(key)}: {reason}"


def _ceased(robot: Client) -> str:
    try:
        if robot.session.info.links():
            return ""
    except zenoh.ZError:
        return ""  # the session is being closed
    where, status = robot.where, Presence(linked=False, here=False)
    return _of_link(where) or explain_silence("", where.robot_id, where.endpoint, status)


def _of_link(where: Address) -> str:
    """Return the fault of a TLS connection, such as an expired certificate.

    Return "" if no fault is found, or if the connection does not use TLS.
    """
    secured = where.tls and where.endpoint.startswith(TLS_PREFIX)
    return trouble(where.endpoint, where.tls) if secured else ""
