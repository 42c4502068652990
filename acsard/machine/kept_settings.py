"""Changes settings of the running robot and keeps them in its configuration file.

The process that calls this writes the file, so it must run on the robot. Nothing is set if the file
cannot be written.
"""

from __future__ import annotations

from collections.abc import Mapping

from msgspec.structs import replace

from acsard.client.connection import Connection
from acsard.core.messages.schema import ServiceReply
from acsard.core.values import Plain
from acsard.host.config_file import change, writable
from acsard.host.errors import MendableError, UsageError
from acsard.host.processes import config_of, is_daemon_here


def can_be_kept(key: str) -> bool:
    return not key.startswith("commands.sources.")


def set_and_keep(
    robot: Connection, config: str | None, settings: Mapping[str, Plain]
) -> ServiceReply:
    """Change settings, write them into the configuration file, and return the reply.

    `config` is the path of the file; None means the usual places. Raises `UsageError` or
    `MendableError` if the file cannot be written.
    """
    if not all(map(can_be_kept, settings)):
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
