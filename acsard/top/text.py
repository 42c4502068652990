"""Formats the values and the lines of the screen of `acsard top`. This module is pure.

The text of each value has a limited length, whatever arrives on the bus. Text from the bus reaches
the terminal only through `clean`, and only inside rich's `Text`, which does not interpret markup.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from msgspec import Struct
from rich.cells import cell_len
from rich.text import Text

from acsard.core.formatting import printable, rough
from acsard.core.messages.schema import Info, RobotState

# Styles in the notation of rich.
MODE_STYLES = {
    "driving": "bold white on green",
    "ready": "bold white on blue",
    "waiting": "bold black on yellow",
    "shutdown": "bold black on yellow",
    "inactive": "bold black on white",
    "stopped": "bold white on red",
    "fault": "bold white on red",
}


class ScreenData(Struct, frozen=True):
    """What the screen of `acsard top` shows. Rates compare `state` with the earlier `before`."""

    robot_id: str
    endpoint: str
    state: RobotState | None
    before: RobotState | None = None
    age: float = 0.0  # since `state` arrived, or since the wait for the first one began
    info: Info | None = None
    undecodable: int = 0  # messages since the last readable state
    hint: str = ""
    silent: bool = False  # no state has arrived for too long
    # s between `before` and `state` on this computer; other stamps: an adjusted clock
    passed: float = 0.0


_EIGHTHS = " ▏▎▍▌▋▊▉█"


def clean(text: str) -> str:
    """Return at most 256 characters of a text, with visible ones instead of control characters."""
    # No screen shows more than 256 characters of a text.
    return "".join(c if cell_len(c) else "\ufffd" for c in printable(text[:256]))


def count(number: int) -> str:
    """Format an integer with thousands separators, from 10^10 on with an exponent."""
    if abs(number) < 10**10:
        return f"{number:,}"
    return f"{float(max(-(10**300), min(10**300, number))):.1e}"


def seen(age: float | None) -> str:
    """Format the age of a source's last command, s; "-" if none counts, such as after a `clear`."""
    return "-" if age is None else rough(age)


def rate(later: int, earlier: int, seconds: float) -> str:
    """Return a counter's increase per second in at least 7 characters; "-/s" if not plausible."""
    # After a clock change or a restart of the daemon, a wrong rate must not be shown.
    if not 0.05 <= seconds <= 60.0 or not 0 <= later - earlier < 10**6:
        return "-/s".rjust(7)
    hz = (later - earlier) / seconds
    return f"{hz:5.1f}/s" if hz < 999.95 else f"{hz:5.0f}/s"


def bar(value: float, scale: float, cells: int) -> str:
    """Return a bar of block characters, `cells` long from the magnitude `scale` on."""
    if not math.isfinite(value):
        return ""
    eighths = round(min(1.0, abs(value) / scale) * cells * 8)
    return ("█" * (eighths // 8) + _EIGHTHS[eighths % 8]).strip()


# Lines.


def row(label: str, value: str, style: str = "") -> Text:
    return Text.assemble((f"{label:<12}", "dim"), (value, style))


def ends(left: Text, right: Text, width: int) -> Text:
    """Return a line of `width` cells with a text at each end. If it is too short, `left` is cut."""
    left.truncate(max(0, width - right.cell_len - 2), overflow="ellipsis")
    return left.append(" " * (width - left.cell_len - right.cell_len)).append_text(right)


def rule(width: int, titles: Sequence[tuple[int, str | Text]]) -> Text:
    """Return a horizontal line with titles, as pairs of column and title."""
    line = Text()
    for at, title in titles:
        if at:
            line.append("─" * (at - line.cell_len - 1) + " ", "dim")
        line.append_text(title if isinstance(title, Text) else Text(title, "cyan")).append(" ")
    return line.append("─" * max(0, width - line.cell_len), "dim")


def flow(parts: Sequence[Text], width: int, inset: int = 0) -> list[Text]:
    """Return lines of at most `width` cells, each with as many of the parts as fit.

    A longer part is alone. Lines after the first begin with `inset` blanks.
    """
    lines: list[Text] = []
    for part in parts:
        if lines and lines[-1].cell_len + 2 + part.cell_len <= width:
            lines[-1].append("  ").append_text(part)
        else:
            lines.append(Text(" " * (inset if lines else 0)).append_text(part))
    return lines
