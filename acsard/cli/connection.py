"""Shared code of the subcommands that use the bus: options, connections, keys and explanations."""

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
from acsard.bus.robot_discovery import ALL_ROBOTS, Presence, explain_silence, parse_ids, presence
from acsard.bus.tls import trouble
from acsard.cli.common import add_config, load
from acsard.client.connection import Connection, open_connection
from acsard.client.follower import FIRST_STATE_TIMEOUT_S
from acsard.core.config.settings import TLS_PREFIX
from acsard.core.formatting import printable
from acsard.core.messages.keys_and_roles import key_hint, row_of, unknown
from acsard.host.errors import UsageError

SEVERAL_IDS = "; several ids separated by commas, or '*' for all robots"


def add_bus(parser: argparse.ArgumentParser, more: str = "", default: object = None) -> None:
    """Add the options that select a robot and its daemon's address; `more` help for `--id`.

    With the `default` `argparse.SUPPRESS`, a subcommand keeps the value that stood before it.
    """
    add_config(parser, default)
    for option, metavar, text in (
        ("--connect", "ENDPOINT", "address of the daemon, e.g. tcp/127.0.0.1:7448"),
        (
            "--tls",
            "DIRECTORY",
            "directory with your certificate, for a tls/ endpoint (default: $ACSARD_TLS, or "
            "bus.tls)",
        ),
        ("--id", "ID", "the robot's id (default: robot.id)" + more),
    ):
        parser.add_argument(option, metavar=metavar, default=default, help=text)


@contextmanager
def connected(args: argparse.Namespace, source: str = "app") -> Iterator[Connection]:
    """Yield a client of the one robot that the options name. Raises `UsageError` for several."""
    with open_connection(robot_address(args), source) as robot:
        yield robot


def robot_address(args: argparse.Namespace) -> Address:
    """Return the address of the robot that the options name. Raises `UsageError` for several."""
    require_one(args)
    _, config = load(args.config)
    return address_of(config, args.connect, args.id, args.tls)


def several_ids(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the ids in `--id` if it names several robots, ("*",) for all, otherwise ()."""
    return parse_ids(args.id or "")


def require_one(args: argparse.Namespace) -> None:
    """Raise `UsageError` if `--id` names several robots."""
    if several_ids(args):
        raise UsageError(
            f"--id '{args.id}' names several robots, but `acsard {args.verb}` takes one: "
            "`acsard fleet` lists the robots; only echo, get, set, fleet and call stop take several"
        )


@contextmanager
def connected_to_many(args: argparse.Namespace) -> Iterator[tuple[Connection, tuple[str, ...]]]:
    """Yield a client, and the ids of the robots to use by `Connection.sibling`.

    These are () for one robot, which is the client's. For `--id '*'` they are "*" and the robots of
    `[fleet] robots`, which must answer.
    """
    many = several_ids(args)
    _, config = load(args.config)
    if ALL_ROBOTS in many:
        many += config.fleet.robots
    where = address_of(config, args.connect, None if many else args.id, args.tls)
    with open_connection(where) as robot:
        yield robot, many


def require_followed(key: str) -> None:
    """Raise `UsageError` for a key that does not exist, or on which nothing is published.

    A misspelt key would look like a silent robot. A key may contain wildcards.
    """
    if unknown(key) and not set(key) & set("*$"):
        raise UsageError(f"{key} is not a key of the robot: {key_hint(key)}")
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

    It must answer, not have a wildcard (only one answer is printed), and not be a service, which a
    query would call.
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
    """Yield a function to be called for each message, and print the reason if none arrives.

    A thread does this on standard error. `look` is asked once after `after_s`, and `ceased` every
    `after_s` of a later silence until it has a reason; "" prints nothing. The block ends by itself
    after `timeout_s` without a message, and the reason is printed before if there was none.
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

    Thread(name="waiting", target=print_reasons, daemon=True).start()
    try:
        yield come.set
        if time.monotonic() - began_s >= timeout_s:
            looked.wait()
    finally:
        end.set()
        come.set()


def silence_explained(
    robot: Connection, key: str, timeout_s: float | None = None
) -> AbstractContextManager[Callable[[], None]]:
    """Return `explained` for a key, or if it is "", only for a lost connection.

    The caller leaves the context after `timeout_s` without a message.
    """
    return explained(
        lambda: _none_yet(robot, key) if key else "",
        lambda: _ceased(robot),
        timeout_s=math.inf if timeout_s is None else timeout_s,
    )


def _none_yet(robot: Connection, key: str) -> str:
    where = robot.where
    status = presence(robot.session, where.robot_id, where.endpoint)
    if status is None:
        return ""
    reason = "" if status.linked else _of_link(where)
    reason = reason or explain_silence(key, where.robot_id, where.endpoint, status)
    return f"waiting for messages on {robot.key(key)}: {reason}"


def _ceased(robot: Connection) -> str:
    try:
        if robot.session.info.links():
            return ""
    except zenoh.ZError:
        return ""  # the session is being closed
    where, status = robot.where, Presence(linked=False, here=False)
    return _of_link(where) or explain_silence("", where.robot_id, where.endpoint, status)


def _of_link(where: Address) -> str:
    # "": no fault is found, or no TLS is used.
    secured = where.tls and where.endpoint.startswith(TLS_PREFIX)
    return trouble(where.endpoint, where.tls) if secured else ""
