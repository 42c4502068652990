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
    """The data that `acsard drive` shows: the robot's state and the speeds that the keys set."""

    robot_id: str
    endpoint: str
    source: str
    linear: float
    """Forward speed that a driving key requests, m/s."""
    angular: float
    """Turn rate that a driving key requests, rad/s."""
    state: RobotState | None
    age: float
    """Seconds since `state` arrived, or since the wait for the first state began."""
    objection: str = ""
    """Reason why the robot does not follow the keys, in words; "" if it follows the keys."""
    silent: bool = False
    """True if no state has arrived for too long, so the shown data is old."""


def lines(teleop: Teleop, width: int, height: int | None = None) -> list[Text]:
    """Return the lines of the screen of `acsard drive`.

    There are at most `height` lines, or any number if `height` is None. A line has at most `width`
    character cells. A `width` below 20 counts as 20.
    """
    width = max(20, width)
    head = printable(f"{teleop.robot_id} as {teleop.source}  {teleop.endpoint}")
    rows = [Text(head, "bold")]
    if teleop.silent or teleop.state is None:
        rows += _wrapped(silence(teleop), width, "bold red")
    if teleop.state is not None:
        state = teleop.state
        mode = f" {printable(state.mode).upper()} "
        mode_lines = _wrapped(f"{mode} {printable(state.reason)}", width, "bold")
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
    """Return the lines of a report about the robot, for a terminal that cannot show a screen.

    The report has the content of the screen, but not the help about the keys. A line has at most
    `width` characters. A `width` below 20 counts as 20.
    """
    parts = [f"keys ask for {selected_speeds(teleop)}"]
    if teleop.state is None or teleop.silent:
        return _wrap_parts([silence(teleop), *parts], width)
    if teleop.objection:
        parts.insert(0, refused(teleop))
    why = f"{printable(teleop.state.mode)}: {printable(teleop.state.reason)}"
    return _wrap_parts([why, *parts], width, measured(teleop.state))


def last_report_lines(teleop: Teleop, width: int) -> list[str]:
    """Return the lines of the last report, which is printed when `acsard drive` ends.

    The report says whether the robot still moves, and contains its mode with the reason, its pose
    and its speeds. A line has at most `width` characters.
    """
    if teleop.state is None or teleop.silent:
        return _wrap_parts([f"drive ended: {silence(teleop)}"], width)
    what = "still moves" if moves(teleop.state) else "stands still"
    if teleop.state.linear is None:
        what = "reports no speed"
    why = f"{printable(teleop.state.mode)}: {printable(teleop.state.reason)}"
    return _wrap_parts([f"drive ended: the robot {what}", why], width, measured(teleop.state))


def released(teleop: Teleop) -> bool:
    """Return whether the robot stands still and no longer follows this drive's command source.

    Return False if no state has arrived. A robot without a measured speed counts as standing still.
    """
    if teleop.state is None or moves(teleop.state):
        return False
    return teleop.state.mode != Mode.DRIVING or teleop.state.source != teleop.source


def moves(state: RobotState) -> bool:
    """Return whether any measured speed is not zero. Return False if no speed is known."""
    return any((state.linear, state.angular, *state.wheels))


def silence(teleop: Teleop) -> str:
    """Return a sentence which says that the first state, or a newer state, has not arrived yet."""
    if teleop.state is None and not teleop.silent:
        return "waiting for the first state message of the daemon"
    return f"nothing received from the daemon for {teleop.age:.0f} s: is the daemon running?"


def refused(teleop: Teleop) -> str:
    """Return a sentence which says that the keys do not drive the robot, and why."""
    return f"your keys do not drive the robot: {printable(teleop.objection)}"


def selected_speeds(teleop: Teleop) -> str:
    return f"{teleop.linear:.2f} m/s, {teleop.angular:.2f} rad/s"


def measured(state: RobotState) -> list[Text]:
    """Return the robot's pose and measured twist as short texts with units."""
    texts = [*place(state.x, state.y, state.yaw), *speeds(state.linear, state.angular)]
    return [Text(text) for text in texts]


def _wrap_parts(parts: Sequence[str], width: int, figures: Sequence[Text] = ()) -> list[str]:
    width = max(20, width)
    lines = wrap("; ".join(parts), width, subsequent_indent="  ", break_on_hyphens=False)
    return [*lines, *(f"  {line}" for line in flow(figures, width - 2))]


def _wrapped(text: str, width: int, style: str) -> list[Text]:
    return [Text(line, style) for line in wrap(text, width, subsequent_indent="  ")]
