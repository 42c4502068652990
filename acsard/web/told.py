"""What `/ws` says to a page or a program; pure.

One JSON object a message; what it is is told by its first field. The messages of a key alone are
put together elsewhere (to_browser.py), since those come as JSON already.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
from msgspec import Struct

from acsard.values import Role
from acsard.web.minute import Plotted

Point = tuple[float, float]


class Limits(Struct, frozen=True):
    """The highest speeds: m/s and rad/s."""

    linear: float
    angular: float


class Greeting(Struct, frozen=True):
    """Which robot it is, and who is here."""

    robot: str
    version: str
    role: Role
    sender: str
    """The public name that `state.sender` has while this viewer drives."""
    limits: Limits
    simulated: bool
    state_rate: float
    """Hz"""


class Hello(Struct, frozen=True):
    """First of all, and when that changes."""

    hello: Greeting


class Way(Struct, frozen=True):
    """Where the robot was in the last ten minutes, m in the odom frame, oldest first."""

    path: Sequence[Point]
    truth: Sequence[Point]
    """Where it truly was, of the simulator."""


class LastMinute(Struct, frozen=True):
    """What the plots show."""

    minute: Plotted


class Answer(Struct, frozen=True):
    """Of a call, by the number or name it was called with."""

    answer: int | str
    ok: bool
    text: str


class Row(Struct, frozen=True):
    """One robot."""

    robot: str
    mode: str | None
    """As in `state`; "gone" once its daemon has said that it ends, None while nothing is heard."""
    reason: str
    speed: float | None
    """m/s"""
    link: str
    age: float | None
    """s since its state was heard, or its daemon ended."""
    version: str
    """"" until it says."""


class Rows(Struct, frozen=True):
    """The robots that are known."""

    fleet: Sequence[Row]
    note: str
    """Why there are no more; "" where all of a router are seen."""


class Pong(Struct, frozen=True):
    """As asked for, and the clock here, ms since 1970."""

    pong: float
    now: float


class Refused(Struct, frozen=True):
    """What does not count."""

    refused: str
    reason: str


class Gone(Struct, frozen=True):
    """The daemon is not heard."""

    gone: str


class Running(Struct, frozen=True, omit_defaults=True):
    """What goes on, "" when nothing does, by whom, and whether that is you."""

    running: str
    by: str = ""
    yours: bool | None = None


class Ended(Struct, frozen=True):
    """Exit code, that in words, and why."""

    ended: int
    meaning: str
    text: str


class Guided(Struct, frozen=True):
    """A check or a calibration: that it goes on, what it says line by line, how it ended."""

    guide: Running | msgspec.Raw | Ended
