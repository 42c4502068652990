"""Formats the lines of text with which `acsard drive` shows the robot. This module is pure.

The lines fit on a terminal of any width.
"""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap

from msgspec import Struct
from rich.text import Text

from acsard.core.formatting import printable
from acsard.core.messages.schema import RobotState
from acsard.core.messages.short_texts import place, speeds
from acsard.core.motion.modes import Mode
from acsard.top.text import MODE_STYLES, flow

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


def lines(teleop: Teleop, width: int, height: int | None = None) -> list[Text]:
    """Return the screen of `acsard drive`, in lines of at most `width` cells (at least 20)."""
    width = max(20, width)
    head = printable(f"{teleop.robot_id} as {teleop.source}  {teleop.endpoint}")
    rows = [Text(head, "bold")]
    if teleop.silent or teleop.state is None:
        rows += _wrapped(silence(teleop), width, "bold red")
    if teleop.state is not None:
        state = teleop.state
        mode = f" {printable(state.mode).upper()} "
        mode_lines = _wrapped(f"{mode} {printable(state.why)}", width, "bold")
        for first in mode_lines[:1]:
            first.stylize(MODE_STYLES.get(state.mode, "reverse"), 0, len(mode))
        rows += mode_lines
        if teleop.objection:
            rows += _wrapped(refused(teleop), width, "bold red")
        rows += flow(measured(state), width)
    rows.append(Text(f"keys ask for {selected_speeds(teleop)}"))
    below = [Text(line, "dim") for line in HELP]
    if height is not None and len(rows) + len(below) >= height:
        rows = [*rows[: max(1, height - len(below))], *below][:height]
    else:
        rows += [Text(), *below]
    for line in rows:
        line.truncate(width, overflow="ellipsis")
    return rows


def report_lines(teleop: Teleop, width: int) -> list[str]:
    """Return a report with the content of the screen, for a terminal that cannot show one."""
    parts = [f"keys ask for {selected_speeds(teleop)}"]
    if teleop.state is None or teleop.silent:
        return _wrap_parts([silence(teleop), *parts], width)
    if teleop.objection:
        parts.insert(0, refused(teleop))
    why = f"{printable(teleop.state.mode)}: {printable(teleop.state.why)}"
    return _wrap_parts([why, *parts], width, measured(teleop.state))


def last_report_lines(teleop: Teleop, width: int) -> list[str]:
    """Return the last report: whether the robot moves, its mode, pose and speeds."""
    if teleop.state is None or teleop.silent:
        return _wrap_parts([f"drive ended: {silence(teleop)}"], width)
    what = "still moves" if moves(teleop.state) else "stands still"
    if teleop.state.linear is None:
        what = "reports no speed"
    why = f"{printable(teleop.state.mode)}: {printable(teleop.state.why)}"
    return _wrap_parts([f"drive ended: the robot {what}", why], width, measured(teleop.state))


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


def refused(teleop: Teleop) -> str:
    """Say that the keys do not drive the robot, and why."""
    return f"your keys do not drive the robot: {printable(teleop.objection)}"


def selected_speeds(teleop: Teleop) -> str:
    return f"{teleop.linear:.2f} m/s, {teleop.angular:.2f} rad/s"


def measured(state: RobotState) -> list[Text]:
    """Return pose and measured twist as short texts with units."""
    texts = [*place(state.x, state.y, state.yaw), *speeds(state.linear, state.angular)]
    return [Text(text) for text in texts]


def _wrap_parts(parts: Sequence[str], width: int, figures: Sequence[Text] = ()) -> list[str]:
    width = max(20, width)
    lines = wrap("; ".join(parts), width, subsequent_indent="  ", break_on_hyphens=False)
    return [*lines, *(f"  {line}" for line in flow(figures, width - 2))]


def _wrapped(text: str, width: int, style: str) -> list[Text]:
    return [Text(line, style) for line in wrap(text, width, subsequent_indent="  ")]
