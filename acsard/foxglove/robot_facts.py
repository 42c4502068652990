"""The robot's configuration, and the permissions of this program, for the Foxglove bridge."""

from __future__ import annotations

import msgspec
from msgspec import Struct

from acsard.client import Client
from acsard.core.config.parsing import from_builtins
from acsard.core.config.settings import Config
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.permissions import COMMAND_ROLE, has, least_role
from acsard.core.ros.channels import CMD_VEL_IN, SOURCE_PLACEHOLDER, Channel, published_channels
from acsard.core.ros.transports import left_out
from acsard.host.errors import ReplyError


class Facts(Struct, frozen=True):
    """The configuration of a robot, and the permissions of this program.

    If this program may not read the robot's configuration, `config` has the default values.
    """

    config: Config
    tables: object
    """The robot's configuration as nested dicts. None if this program may not read the
    configuration."""
    sources: tuple[str, ...]
    """Names of the robot's command sources."""
    forbidden: str
    """Reason why this program may not drive the robot, in words; "" if it may drive."""
    commands_hidden_reason: str = ""
    """Reason why this program cannot receive the commands of other programs, in words; "" if it
    can."""

    def rows(self) -> list[tuple[Channel, str]]:
        """Return the topics to offer to the viewers, as pairs (topic, command source).

        `CMD_VEL_IN` appears once for each command source. For every other topic, the command source
        is "".
        """
        pairs = []
        for row in published_channels(left_out(self.config)):
            names = self.sources if row is CMD_VEL_IN else ("",)
            pairs += [(row, name) for name in names]
        return pairs


def key_of(row: Channel, source: str) -> str:
    """Return the Zenoh key of a topic, without its beginning `acsard/<robot.id>/`.

    Only the topic `CMD_VEL_IN` has a key for each command source. All other topics ignore `source`.
    """
    return row.native.replace(SOURCE_PLACEHOLDER, source)


def learn(robot: Client) -> Facts:
    """Query the robot for its configuration, its command sources, and this program's permissions.

    Raises the errors of `Client.get`, and `ReplyError` if a reply is not readable.
    """
    forbidden, role, commands_hidden_reason = "", "maintainer", ""
    if robot.where.tls:
        commands_hidden_reason = (
            "clients over TLS cannot receive the commands that programs send to the robot "
            "(/cmd_vel_in/…): to see these commands, either run `acsard foxglove` on the robot, or "
            "use `acsard recording export` later"
        )
        us = robot.whoami()
        role = us.role
        forbidden = "" if has(role, COMMAND_ROLE) else us.describe()
    try:
        sources = tuple(source.name for source in robot.get("state").sources)
        tables = robot.get("config") if has(role, least_role("config")) else None
        config = Config() if tables is None else from_builtins(tables)
    except (DecodeError, msgspec.ValidationError) as error:
        raise ReplyError(
            f"cannot read the robot's state ({error}); is the daemon a different version? Use "
            "the same version here"
        ) from None
    return Facts(config, tables, sources, forbidden, commands_hidden_reason)
