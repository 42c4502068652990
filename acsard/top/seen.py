"""What `acsard top` has seen of a robot: what the feed gives and the screen shows."""

from __future__ import annotations

from msgspec import Struct

from acsard.messages.schema import Info, RobotState

SILENT_S = 2.0
"""Without a state for this long at least there is no news, and all below is old."""


class Seen(Struct, frozen=True):
    """All that the screen tells; `before` is an earlier state to take rates from."""

    robot_id: str
    endpoint: str
    state: RobotState | None
    before: RobotState | None = None
    age: float = 0.0
    """Since `state` came, or since we began to wait for one, s."""
    info: Info | None = None
    undecodable: int = 0
    """Messages in the state's place that are none."""
    hint: str = ""
    silence: float = SILENT_S
    """The age from which on it is a silence, s."""
    passed: float = 0.0
    """From `before` to `state` by our own clock, s: about what their stamps say, unless the robot's
    clock was set meanwhile."""
