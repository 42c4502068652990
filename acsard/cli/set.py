"""Change settings of the running robot: limits, timeouts, covariances, publishing rates, the log
level. Either all given settings change or none. The daemon checks them like the configuration file,
logs them and publishes them on the key `config`. They last until the daemon's next start; only a
lowered speed, acceleration or jerk survives it. --write also puts the settings into the
configuration file, except a source's timeout: edit [[commands.sources]] yourself. The robot
decelerates to a lowered speed limit. Without a setting, list the settings that can be changed. The
exit code is 1 if the robot refuses.
"""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Sequence
from pathlib import Path

import msgspec

from acsard.cli.connection import add_bus, connected
from acsard.core.config.live import flat, live
from acsard.core.config.lowered import stays
from acsard.core.config.validation import show
from acsard.core.formatting import json_line, lines
from acsard.core.messages.encodings import encode
from acsard.core.ros.parameters import described
from acsard.core.values import Plain
from acsard.host.config_file import change, require_changeable, writable
from acsard.host.errors import Exit, MendableError, UsageError
from acsard.host.extras import install


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "settings",
        nargs="*",
        metavar="KEY VALUE",
        help="a key of acsard.toml with its table, for example limits.linear_speed; write a "
        "list as [1, 2]",
    )
    parser.add_argument(
        "--write",
        action="store_true",
        help="also write them into the local configuration file and keep its comments (needs an "
        f"extra: {install('write')})",
    )
    parser.add_argument("--json", action="store_true", help="print the answer or the list as JSON")
    add_bus(parser)


def main(args: argparse.Namespace) -> int:
    settings = pairs(args.settings)
    file = _file(args.config, settings) if args.write else None
    if file is not None:
        require_changeable(file, settings)
    with connected(args) as robot:
        if not settings:
            _tell(robot.get("config"), args.json)
            return int(Exit.OK)
        reply = robot.set(settings)
    until = "until the next start"
    if any(stays(key) for key in settings):
        until += "; a lowered limit survives the restart"
    if reply.success and file is not None:
        try:
            change(file, settings)
        except MendableError as error:
            raise MendableError(f"{reply.message}, {until}; not written: {error}") from None
        until = f"written to {file}"
    text = f"{reply.message}; {until}" if reply.success else reply.message
    print(json_line(encode(reply, "json").decode()) if args.json else lines(text))
    return int(Exit.OK if reply.success else Exit.FAILURE)


def pairs(words: Sequence[str]) -> dict[str, Plain]:
    """Return the settings from the words KEY VALUE KEY VALUE ...

    A value is read as TOML; a bare word is a string. Raises `UsageError` if a value is missing.
    """
    if len(words) % 2:
        raise UsageError("give pairs of KEY VALUE, for example acsard set limits.linear_speed 0.8")
    return {key: _value(word) for key, word in zip(words[::2], words[1::2], strict=True)}


def _value(word: str) -> Plain:
    try:
        found = tomllib.loads(f"value = {word}")
    except (tomllib.TOMLDecodeError, ValueError, RecursionError):
        return word
    value: Plain = found["value"]
    one = len(found) == 1 and isinstance(value, bool | int | float | str | list)
    return value if one else word


def _file(path: str | None, settings: dict[str, Plain]) -> Path:
    """Return the file that --write is to change. Raises `UsageError` before anything is set."""
    if not settings:
        raise UsageError("--write needs a setting: acsard set limits.linear_speed 0.8 --write")
    if any(key.startswith("commands.sources.") for key in settings):
        raise UsageError(
            "--write cannot change [[commands.sources]]: set the timeout without --write, and "
            "write it into the file yourself. If the file has no [[commands.sources]], copy all "
            "of these tables from `acsard check`, because those in the file replace the "
            "built-in ones"
        )
    return writable(path)


def _tell(config: object, as_json: bool) -> None:
    """Print the settings that can be changed, with their present values."""
    now = {key: value for key, value in flat(config) if live(key)}
    if as_json:
        print(msgspec.json.encode(now).decode())
        return
    for key, value in now.items():
        said = described(key, 1)
        told = f"{key} = {show(value)}\n    {said.description}\n    {said.additional_constraints}"
        print(lines(told))
