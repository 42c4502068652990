"""What has to be known of a robot before it is shown, and again when its daemon comes back."""

from __future__ import annotations

import msgspec
from msgspec import Struct

from acsard.client import Client
from acsard.config.parsing import from_builtins
from acsard.config.settings import Config
from acsard.host.errors import ReplyError
from acsard.messages.encodings import DecodeError
from acsard.ros.channels import CMD_VEL_IN, SOURCE, Channel, said
from acsard.ros.transports import left_out

DEAF = (
    "what the sources command (/cmd_vel_in/…) is told to nobody who comes by TLS: see it with "
    "`acsard foxglove` at the robot, or later by `acsard log export`"
)


class Facts(Struct, frozen=True):
    """`config` is the robot's where we may read it, else the defaults."""

    config: Config
    tables: object
    """The same as plain tables; None where we may not read it."""
    sources: tuple[str, ...]
    forbidden: str
    """Why we may not drive, in words; "" when we may."""
    deaf: str = ""
    """Why we hear no commander, in words; "" when we do."""

    def rows(self) -> list[tuple[Channel, str]]:
        """Each channel with its key on the bus; those of the commanders once for each source."""
        found = []
        for row in said(left_out(self.config)):
            names = self.sources if row is CMD_VEL_IN else ("",)
            found += [(row, name) for name in names]
        return found


def key_of(row: Channel, source: str) -> str:
    """The key below the robot's id on which a row is published."""
    return row.native.replace(SOURCE, source)


def learn(robot: Client, tls: str) -> Facts:
    """Ask the robot; raises what `Client.get` raises, and `ReplyError` for another version's."""
    forbidden, role, deaf = "", "maintainer", ""
    if tls:
        deaf = DEAF
        us = robot.whoami()
        role = us.role
        forbidden = "" if role in ("operator", "maintainer") else us.words()
    try:
        sources = tuple(one.name for one in robot.get("state").sources)
        tables = robot.get("config") if role == "maintainer" else None
        config = Config() if tables is None else from_builtins(tables)
    except (DecodeError, msgspec.ValidationError) as error:
        raise ReplyError(
            f"cannot read what the robot says ({error}); is the daemon of another version?"
        ) from None
    return Facts(config, tables, sources, forbidden, deaf)
