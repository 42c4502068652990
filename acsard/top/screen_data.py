"""The data that the feed passes to the screen of `acsard top`."""

from __future__ import annotations

from msgspec import Struct

from acsard.core.messages.schema import Info, RobotState

MODES = {
    "driving": "bold white on green",
    "ready": "bold white on blue",
    "waiting": "bold black on yellow",
    "shutdown": "bold black on yellow",
    "inactive": "bold black on white",
    "stopped": "bold white on red",
    "fault": "bold white on red",
}
"""Colours of the modes, in the words of the library rich."""


class ScreenData(Struct, frozen=True):
    """Everything that the screen shows; `before` is an earlier state, used to compute rates."""

    robot_id: str
    endpoint: str
    state: RobotState | None
    before: RobotState | None = None
    age: float = 0.0
    """Seconds since `state` arrived, or since the wait for the first one began."""
    info: Info | None = None
    undecodable: int = 0
    """Number of consecutive messages on the state's key that could not be decoded."""
    hint: str = ""
    silent: bool = False
    """Whether the robot counts as silent, so that the shown data is old."""
    passed: float = 0.0
    """Seconds from `before` to `state` by the local clock. The stamps differ from it by more than
    the network delay only if the robot's clock was set."""
