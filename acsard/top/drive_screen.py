"""Builds the screen of `acsard drive`, and its report at the end. This module is pure."""

from __future__ import annotations

from msgspec import Struct
from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.text import Text

from acsard.core.formatting import printable
from acsard.core.messages.schema import RobotState
from acsard.core.messages.short_texts import mode_and_reason, place, speeds
from acsard.core.motion.modes import Mode
from acsard.top.screen import mode_line

HELP = (
    " u  i  o    arrows drive, too",
    " j  k  l    space or k stops",
    " m  ,  .    Ctrl-C quits",
    " q/z  both speeds +/- 10 %",
    " w/x  linear only    e/c  angular only",
)


class Teleop(Struct, frozen=True):
    """What `acsard drive` shows: the robot's state and the speeds that the keys set."""

    robot_id: str
    endpoint: str
    source: str
    linear: float  # of a driving key, m/s
    angular: float  # of a driving key, rad/s
    state: RobotState | None
    age: float  # since `state` arrived, or since the wait for the first one began
    objection: str = ""  # why the robot does not follow the keys, or ""
    silent: bool = False  # no state has arrived for too long
    limits: str = ""  # of the robot at the start of this drive, or "" if unknown


def screen(teleop: Teleop) -> Group:
    head = printable(f"{teleop.robot_id} as {teleop.source}  {teleop.endpoint}")
    parts: list[RenderableType] = [Text(head, "bold")]
    if teleop.silent or teleop.state is None:
        parts.append(Text(silence(teleop), "bold red"))
    if teleop.state is not None:
        parts.append(mode_line(teleop.state))
        if teleop.objection:
            words = "your keys do not drive the robot"
            if teleop.objection not in teleop.state.why:  # which stands above
                words += f": {printable(teleop.objection)}"
            parts.append(Text(words, "bold red"))
        parts.append(_measured(teleop.state))
    parts.append(Text(f"keys ask for {velocity(teleop.linear, teleop.angular)}"))
    if teleop.limits:
        parts.append(Text(f"the robot allowed {teleop.limits} when this drive began"))
    return Group(*parts, Text(), Text("\n".join(HELP), "dim"))


def velocity(linear: float, angular: float) -> str:
    return f"{linear:.2f} m/s, {angular:.2f} rad/s"


def last_report(teleop: Teleop) -> Group:
    """Return the last report: whether the robot moves, its mode, pose and speeds."""
    state = teleop.state
    if state is None or teleop.silent:
        return Group(Text(f"drive ended: {silence(teleop)}"))
    what = "still moves" if moves(state) else "stands still"
    if state.linear is None:
        what = "reports no speed"
    why = printable(mode_and_reason(state))
    return Group(Text(f"drive ended: the robot {what}; {why}"), _measured(state))


def _measured(state: RobotState) -> Columns:
    texts = [*place(state.x, state.y, state.yaw), *speeds(state.linear, state.angular)]
    return Columns([Text(text, no_wrap=True) for text in texts], padding=(0, 2))


def released(teleop: Teleop) -> bool:
    """Return whether the robot does not follow this source, and has no measured speed."""
    if teleop.state is None or moves(teleop.state):
        return False
    return teleop.state.mode != Mode.DRIVING or teleop.state.source != teleop.source


def moves(state: RobotState) -> bool:
    """Return whether any measured speed is not zero."""
    return any((state.linear, state.angular, *state.wheels))


def silence(teleop: Teleop) -> str:
    """Say that the first state, or a newer one, has not arrived yet."""
    if teleop.state is None and not teleop.silent:
        return "waiting for the first state message of the daemon"
    return f"nothing received from the daemon for {teleop.age:.0f} s: is the daemon running?"
