"""The messages that `/ws` sends to a page or a program. This module is pure.

Each message is one JSON object, identified by its first field. Messages of subscribed keys are
built in socket_sender.py instead, because their values are already JSON.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
from msgspec import Struct

from acsard.core.values import Role
from acsard.web.last_minute import Plotted

Point = tuple[float, float]


class Limits(Struct, frozen=True):
    """Highest speeds: m/s and rad/s."""

    linear: float
    angular: float


class Greeting(Struct, frozen=True):
    """Identity of the robot and of this viewer."""

    robot: str
    version: str
    role: Role
    sender: str
    """Public name that `state.sender` has while this viewer drives."""
    limits: Limits
    simulated: bool
    state_rate: float
    """Rate of the key `state`, Hz."""
    barred: Mapping[str, str]
    """The actions that this viewer's role does not allow, each with the reason: services, and
    "drive", "recordings" and "begin"."""
    camera: bool
    """Whether `GET /api/camera` has pictures."""


class Hello(Struct, frozen=True):
    """The first message, repeated whenever its content changes."""

    hello: Greeting


class DrivenPath(Struct, frozen=True):
    """Path of the robot in the last ten minutes: m in the odom frame, oldest first."""

    path: Sequence[Point]
    truth: Sequence[Point]
    """True path, published by a simulator only."""


class LastMinute(Struct, frozen=True):
    """Plotted values of the last minute."""

    minute: Plotted


class Answer(Struct, frozen=True):
    """Answer to a call, with the id of that call."""

    answer: int | str
    ok: bool
    text: str


class Row(Struct, frozen=True):
    """One robot of the fleet."""

    robot: str
    mode: str | None
    """Mode as in `state`; "gone" after the daemon announced its end, None before the first
    state."""
    reason: str
    speed: float | None
    """Measured forward speed, m/s."""
    link: str
    age: float | None
    """Seconds since the last state arrived or the daemon ended."""
    version: str
    """Version of the daemon; "" until it is reported."""
    settings_differ: str = ""
    """Settings in force that differ from the robot's configuration file, in words; else empty."""


class Rows(Struct, frozen=True):
    """All known robots."""

    fleet: Sequence[Row]
    note: str
    """Reason why robots may be missing; "" if all robots of a router are visible."""


class Pong(Struct, frozen=True):
    """The number of a ping, and the time of this server in ms since 1970."""

    pong: float
    now: float


class Refused(Struct, frozen=True):
    """A message that was refused, and the reason."""

    refused: str
    reason: str


class Gone(Struct, frozen=True):
    """The daemon is not reachable, with the reason."""

    gone: str


class Running(Struct, frozen=True, omit_defaults=True):
    """The running check or calibration, or "".

    `by` started it, and `yours` is true for this viewer.
    """

    running: str
    by: str = ""
    yours: bool | None = None


class Ended(Struct, frozen=True):
    """End of a check or calibration: exit code, its meaning, and the error text."""

    ended: int
    meaning: str
    text: str


class Guided(Struct, frozen=True):
    """A check or a calibration: that it is running, each line that it prints, and its end."""

    guide: Running | msgspec.Raw | Ended
