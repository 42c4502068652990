"""Shared code of the subcommands: common options, argparse types, and loading the configuration."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import get_args

from msgspec.structs import replace

from acsard.core.config import parsing as configuration
from acsard.core.config.parsing import ConfigError
from acsard.core.config.settings import RECORD_VARIABLE, AngularSpeed, Config, LinearSpeed
from acsard.core.formatting import many
from acsard.host.config_file import find
from acsard.host.errors import Exit, ExitError


def add_config(parser: argparse.ArgumentParser, default: object = None) -> None:
    parser.add_argument(
        "--config",
        default=default,
        metavar="FILE",
        help="configuration file (default: $ACSARD_CONFIG, ./acsard.toml, "
        "/etc/acsard/acsard.toml, or the built-in defaults)",
    )


def add_port(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--port", metavar="DEVICE", help='serial device of the MCU, or "sim" (default: mcu.port)'
    )


def add_outcome(parser: argparse.ArgumentParser, result: str) -> None:
    """Add --json and --write, which stores `result` in the words of the help."""
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--write",
        action="store_true",
        help=f"also write {result} into the configuration file and keep its comments (needs the "
        "extra `tools`)",
    )


def add_speeds(
    parser: argparse.ArgumentParser, linear: float, angular: float, least: float, meaning: str
) -> None:
    """Add --linear and --angular with these defaults, from `least` to what the daemon takes."""
    for name, speed, kind in (("linear", linear, LinearSpeed), ("angular", angular, AngularSpeed)):
        meta = get_args(kind)[1]
        unit = meta.extra["unit"]
        parser.add_argument(
            f"--{name}",
            type=between(least, meta.le, unit),
            default=speed,
            metavar=unit.upper(),
            help=f"{meaning}, from {least:g} to {meta.le:g} {unit} (default: %(default)s)",
        )


def between(least: float, most: float, units: str) -> Callable[[str], float]:
    """Return an argparse type for a number from `least` to `most`, in `units`."""

    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            words = f"{text} is not a number of {units} from {least:g} to {most:g}"
            raise argparse.ArgumentTypeError(words)
        return value

    return number


def whole(units: str, most: int, hint: str = "") -> Callable[[str], int]:
    """Return an argparse type for a whole number from 1 to `most`; `hint` ends the error."""

    def number(text: str) -> int:
        digits = text.isascii() and text.isdecimal() and len(text) <= 9
        if not digits or not 0 < int(text) <= most:
            words = f"{text[:40]} is not a whole number of {units} from 1 to {most}{hint}"
            raise argparse.ArgumentTypeError(words)
        return int(text)

    return number


def overrides(options: Mapping[str, object]) -> dict[str, dict[str, object]]:
    """Return the configuration values of options and environment, by table and key.

    `ACSARD_TLS`, which a systemd unit sets to its credentials, is `bus.tls` unless an option is.
    None is ignored.
    """
    values: dict[str, object] = {}
    if "ACSARD_TLS" in os.environ:
        values["bus.tls"] = os.environ["ACSARD_TLS"]
    values |= {key: value for key, value in options.items() if value is not None}
    result: dict[str, dict[str, object]] = {}
    for key, value in values.items():
        table, _, name = key.partition(".")
        result.setdefault(table, {})[name] = value
    return result


# Options by dotted key.
OPTIONS = {
    "mcu.port": "--port",
    "robot.id": "--id",
    "ros.namespace": "--namespace",
    "record.directory": "--record",
    "bus.listen": "--listen",
    "bus.connect": "--connect",
    "bus.tls": "--tls",
}


def load(path: str | None, options: Mapping[str, object] | None = None) -> tuple[str, Config]:
    """Load the configuration, and return the path of its file, too.

    Print each problem with its file or option, and raise `ExitError`. `options`, by keys of
    `OPTIONS`, win unless they are None.
    """
    where, text = find(path)
    options = options or {}
    typed = {key: OPTIONS[key] for key, value in options.items() if value is not None}
    try:
        return where, configuration.parse(text, overrides(options))
    except ConfigError as error:
        own, added = _problems_of_file(text), ", ".join(typed.values())
        places = [where if problem in own else added for problem in error.problems]
        for place, problem in zip(places, error.problems, strict=True):
            print(f"{place}: {problem}", file=sys.stderr)
        count = many(len(error.problems), "problem")
        raise ExitError(
            Exit.BAD_CONFIG, f"{count} in {' and '.join(dict.fromkeys(places))}"
        ) from None


def _problems_of_file(text: bytes) -> Sequence[str]:
    # The options cause all other problems.
    try:
        configuration.parse(text, {})
    except ConfigError as error:
        return error.problems
    return ()


def with_record_directory(config: Config) -> Config:
    """Return `config` with an absolute path of the recording directory.

    Otherwise it is ACSARD_RECORD, which the systemd units set, or "".
    """
    # The path is absolute because a client that receives it over the bus may run in another working
    # directory.
    path = config.record.directory or os.environ.get(RECORD_VARIABLE, "")
    directory = os.path.abspath(path) if path else ""
    return replace(config, record=replace(config.record, directory=directory))
