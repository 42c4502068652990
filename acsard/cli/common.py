"""Shared by the verbs: the configuration, and the types of their options."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable

from msgspec.structs import replace

from acsard.core.config import parsing as configuration
from acsard.core.config.parsing import ConfigError
from acsard.core.config.settings import RECORD, Config
from acsard.core.formatting import many
from acsard.host.config_file import find
from acsard.host.errors import Exit, ExitError

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


def count(text: str) -> int:
    """Return a whole number of at least 1: an argparse type."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} is less than 1")
    return number


def seconds(text: str) -> float:
    """Return a duration from 1 to 600 s: an argparse type.

    All that is measured stays in memory to the end. At 100 Hz that is 60 MB in 600 s.
    """
    value = float(text)
    if not 1.0 <= value <= 600.0:
        raise argparse.ArgumentTypeError(f"{text} is not from 1 to 600 s")
    return value


def whole(units: str, most: int, hint: str = "") -> Callable[[str], int]:
    """Return an argparse type for a whole number from 1 to `most`; `hint` ends its message."""

    def number(text: str) -> int:
        if not text.isascii() or not text.isdecimal() or not 0 < int(text) <= most:
            words = f"{text} is not a whole number of {units} from 1 to {most}{hint}"
            raise argparse.ArgumentTypeError(words)
        return int(text)

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
