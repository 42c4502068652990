"""Shared by the verbs: loading the configuration, and the options of tools that use the bus."""

from __future__ import annotations

import argparse
import os
import sys

from msgspec.structs import replace

from acsard.core.config import parsing as configuration
from acsard.core.config.parsing import ConfigError
from acsard.core.config.settings import RECORD, Config
from acsard.core.formatting import many, printable
from acsard.core.messages.topics import key_hint, row_of, unknown
from acsard.daemon.bus.address import Address, address_of
from acsard.host.config_file import find
from acsard.host.errors import Exit, ExitError, UsageError

Overrides = dict[str, dict[str, object]]


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add `--config`, which nearly every verb takes."""
    parser.add_argument(
        "--config",
        metavar="FILE",
        help="configuration file (default: $ACSARD_CONFIG, ./acsard.toml, "
        "/etc/acsard/acsard.toml, or the built-in defaults)",
    )


JSON_LINES = (
    "for a program that asks the operator: this tool writes its messages and questions to "
    "standard output as JSON, one object per line, and reads the answers from standard "
    "input in the same form (deploy/web/README.md)"
)

MANY = "; several ids separated by commas, or '*' for all robots"


def add_bus(parser: argparse.ArgumentParser, more: str = "") -> None:
    """Add the options of the tools that talk to a running daemon.

    Args:
        parser: the parser of the verb.
        more: text that is appended to the help of `--id`.
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


def count(text: str) -> int:
    """Return a whole number of at least 1: an argparse type."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} is less than 1")
    return number


def by_environment() -> Overrides:
    """Return the configuration keys that the environment sets.

    `ACSARD_TLS` sets `bus.tls`: for example, systemd puts a service's credentials there.
    """
    return {"bus": {"tls": os.environ["ACSARD_TLS"]}} if "ACSARD_TLS" in os.environ else {}


def load(path: str | None, overrides: Overrides | None = None) -> tuple[str, Config]:
    """Return the path of the configuration and the configuration itself.

    Prints every problem in it and raises `ExitError` if there are any.
    """
    where, text = find(path)
    given = dict(overrides or {})
    given["bus"] = {**by_environment().get("bus", {}), **given.get("bus", {})}
    try:
        return where, configuration.parse(text, given)
    except ConfigError as error:
        for problem in error.problems:
            print(f"{where}: {problem}", file=sys.stderr)
        count = many(len(error.problems), "problem")
        raise ExitError(Exit.BAD_CONFIG, f"{count} in {where}") from None


def recorded(config: Config) -> Config:
    """Fill in the recording directory from the environment if the configuration names none.

    The units of the service set this variable. The path is made absolute, because a client that
    reads it on the bus may run in another directory.
    """
    told = config.record.directory or os.environ.get(RECORD, "")
    directory = os.path.abspath(told) if told else ""
    return replace(config, record=replace(config.record, directory=directory))


def robot_address(args: argparse.Namespace) -> Address:
    """Return the address of one robot from the options, or else from the configuration.

    Raises `UsageError` if `--id` names several robots.
    """
    require_one(args)
    _, config = load(args.config)
    return address_of(config, args.connect, args.id, args.tls)


def require_one(args: argparse.Namespace) -> None:
    """Raise `UsageError` if `--id` names several robots."""
    from acsard.daemon.bus.robot_discovery import named

    if named(args.id or ""):
        raise UsageError(
            f"--id '{args.id}' names several robots, but `acsard {args.verb}` takes one: "
            "`acsard fleet` lists the robots; only echo, get and call stop take several"
        )


def robots_address(args: argparse.Namespace) -> tuple[Address, tuple[str, ...]]:
    """Return the address as `robot_address` does, and the ids if `--id` names several robots.

    The ids are `("*",)` for all robots and `()` for a single robot.
    """
    from acsard.daemon.bus.robot_discovery import named

    many = named(args.id or "")
    _, config = load(args.config)
    return address_of(config, args.connect, None if many else args.id, args.tls), many


def require_followed(key: str) -> None:
    """Raise `UsageError`, with the command to type instead, if a key never has messages."""
    row = row_of(key)
    if row is None:
        return
    instead = {
        "query": f"answers a query: acsard get {key}",
        "service": f"is a service: acsard call {key.removeprefix('srv/')}",
    }.get(row.direction)
    if row.key == "alive":
        instead = "is a token without messages: acsard fleet lists the robots that are present"
    if instead is not None:
        raise UsageError(f"nothing is published on {key}: it {instead}")


def warn_of_unknown(key: str) -> None:
    """Warn if a key is not in the table: waiting on a misspelt key looks like a dead robot."""
    if unknown(key):
        said = f"{key} is not in the topic table ({key_hint(key)}); waiting for it all the same"
        print(f"acsard: {printable(said)}", file=sys.stderr)


def require_asked(key: str) -> None:
    """Raise `UsageError` if `acsard get` cannot ask this key.

    These are keys that do not answer, services, which would act, and wildcards: `get` prints one
    answer.
    """
    if set(key.partition("?")[0]) & set("*$"):
        raise UsageError(
            f"{key} stands for several keys, but get asks one; `acsard topics` lists them"
        )
    row = row_of(key)
    if row is None:
        return
    if row.direction == "service":
        raise UsageError(f"{key} is a service: acsard call {key.removeprefix('srv/')}")
    if row.direction == "in":
        raise UsageError(
            f"{key} is an input and does not answer queries: acsard echo {key} follows it"
        )
    if row.key == "alive":
        raise UsageError(
            "alive is a token and does not answer queries: acsard fleet lists the robots that "
            "are present"
        )
