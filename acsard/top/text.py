"""What the screen of `acsard top` is written with: short texts and lines; pure.

Values become text of a bounded length, whatever the bus says. Text from the bus reaches a terminal
only through `clean`, and only inside rich's `Text`, which knows no markup.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.cells import cell_len
from rich.text import Text

MOST = 256
"""Characters of one text that are looked at; no screen shows more."""

_EIGHTHS = " ▏▎▍▌▋▊▉█"


def clean(text: str) -> str:
    """The text without what a terminal would obey, hide or draw over its neighbours."""
    return "".join(
        " " if c.isspace() else c if c.isprintable() and cell_len(c) else "\ufffd"
        for c in text[:MOST]
    )


def signed(value: float | None, decimals: int, width: int) -> str:
    """Format a number with its sign, right-aligned: "-" for None and NaN.

    A number that is too long for `width` is written with an exponent.
    """
    if value is None or math.isnan(value):
        return "-".rjust(width)
    text = f"{round(value, decimals) + 0.0:+.{decimals}f}"  # + 0.0: no "-0.00"
    return (text if len(text) <= width else f"{value:+.0e}").rjust(width)


def count(number: int) -> str:
    """A whole number with its thousands apart."""
    if abs(number) < 10**10:
        return f"{number:,}"
    return f"{float(max(-(10**300), min(10**300, number))):.1e}"


def duration(us: float) -> str:
    """Microseconds with about two digits, in 6 characters."""
    if not 0.0 <= us < 1e10:
        return "?"
    if us < 999.5:
        return f"{us:.0f} µs" if us >= 0.5 else "<1 µs"
    value, unit = (us / 1e3, "ms") if us < 999.5e3 else (us / 1e6, "s")
    return f"{value:.1f} {unit}" if value < 9.95 else f"{value:.0f} {unit}"


def ago(seconds: float | None) -> str:
    """How long since something was heard."""
    if seconds is None:
        return "never"
    if not 0.0 <= seconds < 1e9:
        return "?"
    for size, unit in ((1.0, "s"), (60.0, "min"), (3600.0, "h")):
        if seconds < 99.5 * size:
            return f"{seconds / size:.1f} s" if unit == "s" else f"{seconds / size:.0f} {unit}"
    return f"{seconds / 86400:.0f} d"


def rate(later: int, earlier: int, seconds: float) -> str:
    """How often a counter counts, in 7 characters; "-" when that cannot be told."""
    # A clock that was set, a daemon that was started anew: no rate is better than a wrong one.
    if not 0.05 <= seconds <= 60.0 or not 0 <= later - earlier < 10**6:
        return "-/s".rjust(7)
    hz = (later - earlier) / seconds
    return f"{hz:5.1f}/s" if hz < 999.95 else f"{hz:5.0f}/s"


def bar(value: float, scale: float, cells: int) -> str:
    """The size of `value` as a bar of at most `cells` characters, full at `scale`."""
    if not math.isfinite(value):
        return ""
    eighths = round(min(1.0, abs(value) / scale) * cells * 8)
    return ("█" * (eighths // 8) + _EIGHTHS[eighths % 8]).strip()


# lines


def row(label: str, told: str, style: str = "") -> Text:
    """A line with a label before it."""
    return Text.assemble((f"{label:<12}", "dim"), (told, style))


def ends(left: Text, right: Text, width: int) -> Text:
    """One at the left end of a line, one at the right."""
    left.truncate(max(0, width - right.cell_len - 2), overflow="ellipsis")
    return left.append(" " * (width - left.cell_len - right.cell_len)).append_text(right)


def rule(width: int, titles: Sequence[tuple[int, str | Text]]) -> Text:
    """A line across with titles in it, each at its column."""
    line = Text()
    for at, title in titles:
        if at:
            line.append("─" * (at - line.cell_len - 1) + " ", "dim")
        line.append_text(title if isinstance(title, Text) else Text(title, "cyan")).append(" ")
    return line.append("─" * max(0, width - line.cell_len), "dim")
