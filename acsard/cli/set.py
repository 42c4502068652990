"""Change settings of the running robot: limits, timeouts, covariances, publishing rates, the log
level. Either all given settings change or none. The daemon checks them like the configuration file,
logs them and publishes them on the key `config`. They last until the daemon's next start.
With --keep the robot also writes the settings into its own configuration file,
and the answer names that file. With --write this tool writes them into the configuration file of
this machine. --keep and --write cannot write a source's timeout: edit [[commands.sources]] in the
file. A robot that drives faster than a new limit slows down to it.
Without a setting, list the settings that can be changed. If --id names several robots, all of them
get the settings at the same time, and each line has the answer of one robot. The exit code is 1 if
a robot refuses, and 69 if a robot does not answer.
"""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Sequence
from pathlib import Path

import msgspec

from acsard.cli.connection import SEVERAL_IDS, add_bus, connected_to_many, several_ids
from acsard.cli.replies import of_each, print_each
from acsard.client import Client
from acsard.core.config.live import find_live_setting, flat
from acsard.core.config.validation import finite, show
from acsard.core.formatting import json_line, lines
from acsard.core.messages.encodings import encode
from acsard.core.messages.schema import ServiceReply
from acsard.core.ros.parameters import described
from acsard.core.values import Plain
from acsard.host.config_file import change, require_changeable, writable
from acsard.host.errors import Exit, MendableError, UsageError
from acsard.host.extras import install

UNTIL = "a set lasts until the daemon's next start"


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "settings",
        nargs="*",
        metavar="KEY VALUE",
        help="a key of acsard.toml with the name of its table, for example limits.linear_speed, "
        "and the new value; write a list as [1, 2]",
    )
    files = parser.add_mutually_exclusive_group()
    files.add_argument(
        "--keep",
        action="store_true",
        help="the robot also writes the settings into its own configuration file, whose comments "
        "stay. Nothing is set if the daemon may not change that file, if git tracks the file, or "
        "if the robot lacks the library tomlkit",
    )
    files.add_argument(
        "--write",
        action="store_true",
        help="also write the settings into the configuration file of this machine, whose comments "
        f"stay (needs the library tomlkit: {install('write')})",
    )
    parser.add_argument("--json", action="store_true", help="print the answer or the list as JSON")
    add_bus(parser, SEVERAL_IDS + " (to change settings)")


def main(args: argparse.Namespace) -> int:
    settings = pairs(args.settings)
    if args.keep and not settings:
        raise UsageError("--keep needs a setting: acsard set limits.linear_speed 0.8 --keep")
    if several_ids(args):
        _require_for_many(args, settings)
    file = _file(args.config, settings) if args.write else None
    if file is not None:
        require_changeable(file, settings)
    with connected_to_many(args) as (robot, many):
        if not settings:
            _print_settings(robot.get("config"), args.json)
            return Exit.OK
        if many:
            return _set_all(robot, many, settings, keep=args.keep, as_json=args.json)
        reply = robot.set(settings, keep=args.keep)
    text = reply.message if args.keep or not reply.success else f"{reply.message}; {UNTIL}"
    if reply.success and file is not None:
        try:
            change(file, settings)
        except MendableError as error:
            raise MendableError(f"{text}; not written: {error}") from None
        text = f"{reply.message}; written to {file}"
    print(json_line(encode(reply, "json").decode()) if args.json else lines(text))
    return Exit.OK if reply.success else Exit.FAILURE


def pairs(words: Sequence[str]) -> dict[str, Plain]:
    """Return the settings in the words that the operator typed: KEY VALUE KEY VALUE ...

    A value is read as TOML. If it is not valid TOML, it is a string. Raises `UsageError` if the
    last value is missing, or if a value contains NaN or infinity.
    """
    if len(words) % 2:
        raise UsageError("give pairs of KEY VALUE, for example acsard set limits.linear_speed 0.8")
    assignments = list(zip(words[::2], words[1::2], strict=True))
    settings = {key: _value(word) for key, word in assignments}
    for key, word in assignments:
        if not finite(settings[key]):
            raise UsageError(f"{key} = {word}: a number must be finite; write one like 0.8")
    return settings


def _value(word: str) -> Plain:
    try:
        document = tomllib.loads(f"value = {word}")
    except (tomllib.TOMLDecodeError, ValueError, RecursionError):
        return word
    value: Plain = document["value"]
    is_plain = len(document) == 1 and isinstance(value, bool | int | float | str | list)
    return value if is_plain else word


def _require_for_many(args: argparse.Namespace, settings: dict[str, Plain]) -> None:
    if not settings:
        raise UsageError("name one robot in --id to list its settings")
    if args.write:
        raise UsageError(
            f"--write changes only the configuration file of this machine, but --id '{args.id}' "
            "names several robots: use --keep instead, and each robot writes its own file"
        )


def _set_all(
    robot: Client, ids: tuple[str, ...], settings: dict[str, Plain], *, keep: bool, as_json: bool
) -> int:
    def change_one(client: Client) -> ServiceReply:
        reply = client.set(settings, keep=keep)
        if as_json or keep or not reply.success:
            return reply
        return ServiceReply(True, f"{reply.message}; {UNTIL}")

    replies = of_each(robot, ids, change_one)
    return print_each(replies, robot, ids, "NO ANSWER: {error}", as_json=as_json)


def _file(path: str | None, settings: dict[str, Plain]) -> Path:
    if not settings:
        raise UsageError("--write needs a setting: acsard set limits.linear_speed 0.8 --write")
    if any(key.startswith("commands.sources.") for key in settings):
        raise UsageError(
            "--write cannot change [[commands.sources]]: set the timeout without --write, and "
            "write it into the file yourself. If the file has no [[commands.sources]] yet, copy "
            "all of these tables from the output of `acsard check` first, because the file's "
            "tables replace all built-in ones"
        )
    return writable(path)


def _print_settings(config: object, as_json: bool) -> None:
    now = {key: value for key, value in flat(config) if find_live_setting(key)}
    if as_json:
        print(msgspec.json.encode(now).decode())
        return
    for key, value in now.items():
        setting = described(key, 1)
        rows = f"{key} = {show(value)}", setting.description, setting.additional_constraints
        text = "\n    ".join(rows)
        print(lines(text))
