"""The values of all messages that are not of a feedback line."""

from __future__ import annotations

from msgspec import Struct

from acsard.core.codes import Reason
from acsard.core.messages.schema import RobotState
from acsard.core.values import (
    BatteryStatus,
    Recording,
    RoutersStatus,
    Seconds,
    SourceStatus,
    Twist,
)


class Snapshot(Struct, frozen=True):
    """The message `state`, and the values that only the other messages need."""

    state: RobotState
    applied: Twist  # commanded, after all limits
    sources: tuple[SourceStatus, ...] = ()
    refused_age_s: Seconds | None = None  # since the last refusal, without new senders
    gyro_bias: float | None = None  # at rest, rad/s; None while unknown
    excluded: tuple[str, ...] = ()  # wheels that the odometry ignores
    slipping: tuple[str, ...] = ()  # sides
    port_released: bool = False  # to another program
    bumper: Reason | None = None  # why one counts as pressed
    battery: BatteryStatus | None = None  # None if never reported
    board: dict[str, str] = {}  # last values of its status lines, and their age in `age_s`, s
    counts_figures: str = ""  # the angles by counts and by speeds that contradict each other
    check: str = "plain"  # form of the serial lines
    unanswered: bool = False  # more than 2 % of the lines
    missed_last_minute: int = 0  # control periods without a step
    routers: RoutersStatus = RoutersStatus()
    recording: Recording = Recording()
    # Why the latches would not survive a restart; None without a file.
    latch_file: str | None = None
