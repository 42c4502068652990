"""Shared code of the subcommands that use the bus: options, connections, keys and explanations."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import zenoh
from msgspec import to_builtins

from acsard.bus.address import Address, address_of
from acsard.bus.robot_discovery import ALL_ROBOTS, Presence, explain_silence, parse_ids, presence
from acsard.bus.tls_trouble import trouble
from acsard.cli.common import add_config, load
from acsard.client.connection import Connection, open_connection
from acsard.client.follower import FIRST_STATE_TIMEOUT_S
from acsard.core.codes import joined
from acsard.core.config.live import flat
from acsard.core.config.settings import TLS_PREFIX, Config
from acsard.core.formatting import printable
from acsard.core.messages.keys_and_roles import key_hint, row_of, unknown
from acsard.host.errors import UnreachableError, UsageError

SEVERAL_IDS = "; several ids separated by commas, or '*' for all robots"


def add_bus(
    parser: argparse.ArgumentParser,
    more: str = "",
    default: object = None,
    usual: str = "robot.id",
) -> None:
    """Add the options that select a robot and its daemon's address.

    `usual` and `more` are the help's words for the default of `--id` and for other values.
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
        ("--id", "ID", f"the robot's id (default: {usual}){more}"),
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
    if not _names_a_robot(args, config):
        raise _no_robot_named(config)
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


def _names_a_robot(args: argparse.Namespace, config: Config) -> bool:
    # A file with `[fleet] robots` and without robot.id is not a robot's: "acsar" is no robot there.
    robots, default = config.fleet.robots, Config().robot.id
    return args.id is not None or config.robot.id != default or not robots or default in robots


def _no_robot_named(config: Config) -> UsageError:
    return UsageError(
        f"no robot is named: add one of [fleet] robots, such as `--id {config.fleet.robots[0]}`; "
        "`acsard fleet` lists them"
    )


@contextmanager
def connected_to_many(args: argparse.Namespace) -> Iterator[tuple[Connection, tuple[str, ...]]]:
    """Yield a client, and the ids of the robots to use by `Connection.sibling`.

    These are () for one robot, which is the client's. For `--id '*'` they are "*" and the robots of
    `[fleet] robots`, which must answer.
    """
    many = several_ids(args)
    _, config = load(args.config)
    if not _names_a_robot(args, config):
        # One stop too many is better than one too few.
        if getattr(args, "service", "") != "stop":
            raise _no_robot_named(config)
        many = (ALL_ROBOTS,)
    if ALL_ROBOTS in many:
        many += config.fleet.robots
    where = address_of(config, args.connect, None if many else args.id, args.tls)
    with ExitStack() as stack:
        try:
            robot = stack.enter_context(open_connection(where))
        except UnreachableError as error:
            named = [robot_id for robot_id in many if robot_id != ALL_ROBOTS]
            if not named:
                raise
            stops = getattr(args, "service", "") == "stop"
            fate, advice = ("STOPPED", ": go to them") if stops else ("REACHED", "")
            raise UnreachableError(
                f"NO ROBOT WAS {fate}: {', '.join(named)}{advice}. Is the router running (on its "
                f"machine: `systemctl status acsard-router`)? {error}"
            ) from None
        yield robot, many


# What a tool reads, by the direction of the key, and which tool uses the others.
READABLE = {"echo": ("out", "in"), "get": ("out", "query")}
INSTEAD = {
    "query": "has no messages and only answers queries: type acsard get {0}",
    "in": "is an input and does not answer queries: type acsard echo {0} to print the messages "
    "that arrive on it",
    "service": "is a service: type acsard call {1}",
    "alive": "is a Zenoh liveliness token: acsard fleet lists the robots that are present",
}


def require_readable(key: str, verb: str) -> None:
    """Raise `UsageError` if `acsard echo` or `acsard get` cannot read this key.

    A query of a service would call it, and a misspelt key would look like a silent robot.
    """
    has_wildcard = set(key.partition("?")[0]) & set("*$")
    if has_wildcard and verb == "get":
        raise UsageError(
            f"{key} stands for several keys, but get queries only one; `acsard topics` lists them"
        )
    row = row_of(key)
    if row is None:
        if key in dict(flat(to_builtins(Config()))):
            raise UsageError(
                f"{key} is a setting: `acsard set` without arguments prints the settings that you "
                "can change while the daemon runs, and `acsard get config` prints all"
            )
        if unknown(key) and not has_wildcard and verb == "echo":
            raise UsageError(f"{key} is not a key of the robot: {key_hint(key)}")
        return
    kind = row.key if row.key == "alive" else row.direction
    if kind not in READABLE[verb]:
        raise UsageError(f"{key} {INSTEAD[kind].format(key, key.removeprefix('srv/'))}")


class Silence:
    """Prints, once in each silence of a key, why no message arrives.

    Without a key, or after the first message, the only reason is a lost connection.
    """

    def __init__(self, robot: Connection, key: str) -> None:
        self._robot, self._key = robot, key
        self._said, self._due_s = False, FIRST_STATE_TIMEOUT_S

    def heard(self) -> None:
        self._key, self._said, self._due_s = "", False, FIRST_STATE_TIMEOUT_S

    def look(self, quiet_s: float) -> None:
        """Look for a reason, if the silence has lasted long enough since the last look."""
        if quiet_s >= self._due_s:
            self._due_s = quiet_s + FIRST_STATE_TIMEOUT_S
            self.explain()

    def explain(self) -> None:
        """Look for a reason, and print it if it is the first one in this silence."""
        if self._said:
            return
        reason = _none_yet(self._robot, self._key) if self._key else _ceased(self._robot)
        if reason:
            print(f"acsard: {printable(reason)}", file=sys.stderr)
            self._said = True


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
    why = trouble(where.endpoint, where.tls) if secured else None
    return "" if why is None else joined(why).text
