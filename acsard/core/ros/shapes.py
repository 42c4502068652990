"""Converts events and commands to ROS messages."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

from acsard.core.messages.schema import (
    Byte,
    Header,
    LogEvent,
    Time,
    Twist,
    TwistStamped,
    Vector3,
)
from acsard.core.values import Event
from acsard.core.values import Twist as BodyTwist

Natural = Annotated[int, Meta(extra={"cdr": "I"})]


class Log(Struct, frozen=True):
    """The message rcl_interfaces/msg/Log for one event."""

    stamp: Time
    level: Byte
    name: str
    msg: str
    file: str = ""
    function: str = ""
    line: Natural = 0


LEVELS: dict[str, int] = {"debug": 10, "info": 20, "warning": 30, "error": 40}  # in ROS


def log(event: Event | LogEvent, stamp: Time) -> Log:
    """Convert an event to a log message."""
    by = f" (by {event.by})" if event.by else ""
    return Log(stamp, LEVELS.get(event.level, 20), event.name, f"{event.text}{by}")


def command_message(twist: BodyTwist, arrived: Time, frame: str) -> TwistStamped:
    """Convert a received command to a message of `cmd_vel_in/<source>`."""
    return TwistStamped(
        Header(arrived, frame), Twist(Vector3(x=twist.linear), Vector3(z=twist.angular))
    )


class Trigger(Struct, frozen=True):
    """The response of std_srvs/srv/Trigger."""

    success: bool
    message: str
