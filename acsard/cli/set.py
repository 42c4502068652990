"""`acsard set limits.linear_speed 0.8`: change a setting of the running robot."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from acsard.cli.common import add_bus, robot_address
from acsard.core.formatting import json_line, lines
from acsard.host.config_file import writable
from acsard.host.errors import Exit, ExitError
from acsard.host.extras import install

if TYPE_CHECKING:
    from acsard.core.values import Plain

DESCRIPTION = """\
Change settings of the robot that runs, all or none: limits, timeouts, covariances, publishing
rates, the log's level. They are checked as the file is, told in the log and on the key `config`,
and gone with the next start, except a lowered speed, acceleration or jerk, unless --write puts
them into the configuration file too (all but a source's timeout: [[commands.sources]] is yours to
write). A lower speed limit is reached by the deceleration. Without a setting: list
those that there are. Exit 1 when it is refused.
"""


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb and its options."""
    parser = verbs.add_parser(
        "set",
        help="change a setting of the running robot, or list those that can be",
        description=DESCRIPTION,
    )
    parser.add_argument(
        "settings",
        nargs="*",
        metavar="KEY VALUE",
        help="a key of acsard.toml with its table, as limits.linear_speed; write a list as [1, 2]",
    )
    parser.add_argument(
        "--write",
        action="store_true",
        help=f"also into the configuration file here, comments kept (an extra: {install('write')})",
    )
    parser.add_argument("--json", action="store_true", help="print the answer, or list, as JSON")
    add_bus(parser)
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Set the settings, or list them if none is given."""
    from acsard.client import connect
    from acsard.core.config.lowered import stays
    from acsard.core.messages.encodings import encode
    from acsard.host.config_file import change, require_changeable
    from acsard.host.errors import MendableError

    settings = pairs(args.settings)
    file = _file(args.config, settings) if args.write else None
    if file is not None:
        require_changeable(file, settings)
    endpoint, robot_id, tls = robot_address(args)
    with connect(endpoint, robot_id=robot_id, tls=tls) as robot:
        if not settings:
            _tell(robot.get("config"), args.json)
            return int(Exit.OK)
        reply = robot.set(settings)
    until = "until the next start"
    if any(stays(key) for key in settings):
        until += "; a lowered limit survives it"
    if reply.success and file is not None:
        try:
            change(file, settings)
        except MendableError as error:
            raise ExitError(
                Exit.FAILURE, f"{reply.message}, {until}; not written: {error}"
            ) from None
        until = f"written to {file}"
    text = f"{reply.message}; {until}" if reply.success else reply.message
    print(json_line(encode(reply, "json").decode()) if args.json else lines(text))
    return int(Exit.OK if reply.success else Exit.FAILURE)


def pairs(words: Sequence[str]) -> dict[str, Plain]:
    """Return the settings from the words KEY VALUE KEY VALUE ...

    A value is read as TOML; a bare word is a string. Raises `UsageError` if a value is missing.
    """
    from acsard.host.errors import UsageError

    if len(words) % 2:
        raise UsageError("write: acsard set KEY VALUE, as in acsard set limits.linear_speed 0.8")
    return {key: _value(word) for key, word in zip(words[::2], words[1::2], strict=True)}


def _value(word: str) -> Plain:
    import tomllib

    try:
        found = tomllib.loads(f"value = {word}")
    except (tomllib.TOMLDecodeError, ValueError, RecursionError):
        return word
    value: Plain = found["value"]
    one = len(found) == 1 and isinstance(value, bool | int | float | str | list)
    return value if one else word


def _file(path: str | None, settings: dict[str, Plain]) -> Path:
    """Return the file that --write is to change. Raises `UsageError` before anything is set."""
    from acsard.host.errors import UsageError

    if not settings:
        raise UsageError("--write needs a setting: acsard set limits.linear_speed 0.8 --write")
    if any(key.startswith("commands.sources.") for key in settings):
        raise UsageError(
            "--write cannot change [[commands.sources]]: set it without --write, and write the "
            "timeout into the file yourself; a file that has none of these tables needs all that "
            "`acsard check` prints, for those in the file replace the built-in ones"
        )
    return writable(path)


def _tell(config: object, as_json: bool) -> None:
    """Print the settings that can be changed, with their present values."""
    import msgspec

    from acsard.core.config.live import flat, live
    from acsard.core.config.validation import show
    from acsard.core.ros.parameters import described

    now = {key: value for key, value in flat(config) if live(key)}
    if as_json:
        print(msgspec.json.encode(now).decode())
        return
    for key, value in now.items():
        said = described(key, 1)
        told = f"{key} = {show(value)}\n    {said.description}\n    {said.additional_constraints}"
        print(lines(told))
