"""Converts events, commands and the native message `state` to ROS messages.

CDR has no maps, so the counters of `state` are a list, and null is NaN (`cdr_types.py`).
"""

from __future__ import annotations

from typing import Annotated, Any

from msgspec import Meta, Struct

from acsard.core.messages.schema import (
    Byte,
    Header,
    LogEvent,
    RobotState,
    Time,
    Twist,
    TwistStamped,
    Vector3,
)
from acsard.core.values import Event
from acsard.core.values import Twist as BodyTwist

Whole = Annotated[int, Meta(extra={"cdr": "q"})]
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


class Counter(Struct, frozen=True):
    """A counter since the start of the daemon."""

    name: str
    count: Whole


class Source(Struct, frozen=True):
    """A command source, with the fields of the native `SourceState`."""

    name: str
    priority: Whole
    age: float | None
    waits_for: str
    wait: str


class State(Struct, frozen=True):
    """The type acsard/msg/RobotState, with most fields of `RobotState`."""

    header: Header
    mode: str
    code: str
    reason: str
    x: float
    y: float
    yaw: float
    linear: float | None
    angular: float | None
    wheels: list[float]
    feedback_age: float | None
    link: str
    source: str
    sender: str
    sources: list[Source]
    refused: str
    gyro: str
    wheel_fault: str
    pose_doubt: str
    emergency_stop: str
    bumpers: list[bool]
    recording_error: str
    certificate_expiry: str
    counters: list[Counter]


def state(message: RobotState) -> State:
    """Convert a native `RobotState` to acsard/msg/RobotState."""
    converted: dict[str, Any] = {
        "header": Header(message.stamp),
        "sources": [
            Source(s.name, s.priority, s.age, s.waits_for, s.wait) for s in message.sources
        ],
        "bumpers": message.bumpers or [],
        "counters": [Counter(name, count) for name, count in message.counters.items()],
    }
    same = [name for name in State.__struct_fields__ if name not in converted]
    return State(**converted, **{name: getattr(message, name) for name in same})
