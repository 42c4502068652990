"""Change settings of the running robot: limits, timeouts, covariances, publishing rates, the log
level. Either all given settings change or none. The daemon checks them like the configuration file,
logs them and publishes them on the key `config`. They last until the daemon's next start. With
--keep, typed on the robot, this tool also writes them into the robot's configuration file. --keep
cannot write a source's timeout: edit [[commands.sources]] in the file. A robot that drives faster
than a new limit slows down to it.
Without a setting, list the settings that can be changed. If --id names several robots, all of them
get the settings at the same time, and each line has the answer of one robot. The exit code is 1 if
a robot refuses, 77 if your role may not, and 69 if a robot does not answer.
"""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Sequence

import msgspec
from msgspec.structs import replace

from acsard.cli.replies import of_each, print_each
from acsard.cli.robot_options import SEVERAL_IDS, add_bus, connected_to_many, several_ids
from acsard.client.connection import Connection
from acsard.core.config.live import find_live_setting, flat
from acsard.core.config.validation import finite, show
from acsard.core.formatting import json_line, lines
from acsard.core.messages.encodings import encode
from acsard.core.messages.schema import ServiceReply
from acsard.core.ros.parameters import described
from acsard.core.values import Plain
from acsard.host.config_file import change, writable
from acsard.host.errors import Exit, MendableError, UsageError
from acsard.host.processes import config_of, is_daemon_here


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "settings",
        nargs="*",
        metavar="KEY VALUE",
        help="a key of acsard.toml with the name of its table, for example limits.linear_speed, "
        "and the new value; write a list as [1, 2]",
    )
    parser.add_argument(
        "--keep",
        action="store_true",
        help="also write the settings into the robot's configuration file, whose comments stay. "
        "Type this on the robot (with sudo for the file of the service), and name the file with "
        "--config if it is not found by itself. Needs the extra `tools`",
    )
    parser.add_argument("--json", action="store_true", help="print the answer or the list as JSON")
    add_bus(parser, SEVERAL_IDS + " (to change settings)")


def main(args: argparse.Namespace) -> int:
    settings = pairs(args.settings)
    if args.keep and not settings:
        raise UsageError("--keep needs a setting: acsard set limits.linear_speed 0.8 --keep")
    if several_ids(args):
        _require_for_many(args, settings)
    with connected_to_many(args) as (robot, many):
        if not settings:
            _print_settings(robot.get("config"), args.json)
            return Exit.OK
        if many:
            return _set_all(robot, many, settings, as_json=args.json)
        if args.keep:
            reply = _set_and_keep(robot, args.config, settings)
            text = reply.message
        else:
            reply = robot.set(settings)
            text = _with_duration(reply).message
    print(json_line(encode(reply, "json").decode()) if args.json else lines(text))
    return Exit.OK if reply.success else Exit.FAILURE


def pairs(words: Sequence[str]) -> dict[str, Plain]:
    """Return the settings in KEY VALUE KEY VALUE ..., as TOML or else strings.

    Raises `UsageError` without the last value, and for NaN and infinity.
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
    if args.keep:
        raise UsageError(
            f"--keep changes only the file of the robot on which it is typed, but --id '{args.id}' "
            "names several robots: type the command on each robot"
        )


def _set_and_keep(
    robot: Connection, config: str | None, settings: dict[str, Plain]
) -> ServiceReply:
    # Nothing is set if the file cannot be written. `config` is its path, or None.
    if any(key.startswith("commands.sources.") for key in settings):
        raise UsageError(
            "[[commands.sources]] cannot be kept: set the timeout without keeping it, and "
            "write it into the file yourself. If the file has no [[commands.sources]] yet, copy "
            "all of these tables from the output of `acsard check` first, because the file's "
            "tables replace all built-in ones"
        )
    pid = robot.get("info").pid
    if not is_daemon_here(pid):
        raise MendableError(
            "no setting was changed: only a program on the robot can write its file, but the "
            "daemon runs on another machine or in a container: type `acsard set --keep` there"
        )
    file = writable(config)
    reply = robot.set(settings)
    if not reply.success:
        return reply
    try:
        change(file, settings)
    except MendableError as error:
        raise MendableError(f"{reply.message}; not written: {error}") from None
    text, used = f"{reply.message}; written to {file}", config_of(pid)
    if used is not None and used.resolve() != file.resolve():
        text += f", but the daemon uses {used}: start it with `--config {file}`"
    return replace(reply, message=text)


def _with_duration(reply: ServiceReply) -> ServiceReply:
    if not reply.success:
        return reply
    return ServiceReply(True, f"{reply.message}; a set lasts until the daemon's next start")


def _set_all(
    robot: Connection, ids: tuple[str, ...], settings: dict[str, Plain], *, as_json: bool
) -> int:
    def change_one(client: Connection) -> ServiceReply:
        reply = client.set(settings)
        return reply if as_json else _with_duration(reply)

    replies = of_each(robot, ids, change_one)
    return print_each(replies, robot, ids, "NO ANSWER", as_json=as_json)


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
