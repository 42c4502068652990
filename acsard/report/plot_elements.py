"""Makes the elements of a report's pictures, in the format of the library plotly.

They are lists and dicts for JSON, with numbers as doubles in base64, because JSON has no NaN. The
colors suit a light and a dark background; `page.py` sets that, grid and text.
"""

from __future__ import annotations

import binascii
import html
import struct
import textwrap
from collections.abc import Iterable
from typing import Any, NamedTuple

from acsard.core.formatting import printable
from acsard.report.report_data import Mark

COMMANDED, LIMITED, MEASURED = "#e08600", "#2f7ed8", "#159a6b"

END_COLOUR = "#8668b8"

COLOURS = {
    "driving": "#159a6b", "ready": "#8fb8de", "waiting": "#e0b400", "stopped": "#e08600",
    "fault": "#d43d3d", "inactive": "#9a9a9a", "shutdown": END_COLOUR,
    "up": "#8fb8de", "booting": "#e0b400", "stale": "#e08600", "down": "#d43d3d",
    "drives": "#159a6b", "sends": "#8fb8de", "waits": "#e0b400", "refused": "#d43d3d",
    "info": "#2f7ed8", "warning": "#e08600", "error": "#d43d3d",
}  # fmt: skip

UNKNOWN_COLOUR = "#9a9a9a"

# Colors of sources that drive; successive ones are easy to distinguish.
SOURCE_COLOURS = (
    "#159a6b", "#2f6fd8", "#b04fc4", "#8f4f22", "#1ab2d2", "#8a8f00", "#e0588c", "#4a2f8f",
)  # fmt: skip

# When all colors are used, they come again with the next pattern.
FILL_PATTERNS = ("", "/", "x", ".", "-")


def source_style(number: int) -> tuple[str, str]:
    """Return color and pattern of the source that drives, numbered from 0."""
    beyond, place = divmod(number, len(SOURCE_COLOURS))
    return SOURCE_COLOURS[place], FILL_PATTERNS[beyond % len(FILL_PATTERNS)]


WRAP_COLUMNS = 42  # of text at the pointer: fits on a phone

Trace = dict[str, Any]  # a curve, marks or bars, as plotly describes them


class Key(NamedTuple):
    """An entry of a picture's legend."""

    sign: str  # such as "●"
    colour: str  # of CSS
    meaning: str


class Figure(NamedTuple):
    """A picture of the report."""

    name: str
    title: str
    caption: str
    keys: list[Key]
    height: int
    data: list[Trace]
    layout: dict[str, Any]
    timed: bool = True  # the x axis is the time; such pictures zoom together


def label(text: str) -> str:
    """Return a text for plotly: escaped, and wrapped to `WRAP_COLUMNS`."""
    lines = textwrap.wrap(printable(text), WRAP_COLUMNS) or [""]
    return "<br>".join(html.escape(line) for line in lines)


def numbers(values: Iterable[float]) -> dict[str, str]:
    """Return a column of numbers for plotly, as doubles in base64."""
    data = struct.pack(f"<{len(values := list(values))}d", *values)
    return {"dtype": "f8", "bdata": binascii.b2a_base64(data, newline=False).decode()}


def scatter(name: str, x: Iterable[float], y: Iterable[float], **attributes: object) -> Trace:
    """Return a curve, or marks, with further attributes of plotly's `scatter`."""
    return {"type": "scatter", "name": name, "x": numbers(x), "y": numbers(y), **attributes}


def sentence(mark: Mark) -> str:
    """Return the escaped text that an event shows at the pointer."""
    head = f"<b>{label(mark.name.replace('_', ' '))}</b>"
    by = [label(f"by {mark.by}")] if mark.by else []
    return "<br>".join([head, label(mark.text), *by])


def layout() -> dict[str, Any]:
    """Return the layout that all pictures share."""
    return {
        "autosize": True,
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, sans-serif", "size": 13},
        "hovermode": "closest",
        "hoverlabel": {"align": "left", "font": {"size": 13}},
        "showlegend": False,
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "#888", "activecolor": "#2f7ed8"},
    }


def note(text: str, x: float, y: float) -> dict[str, Any]:
    """Return a title in a picture: left edge as a fraction, middle on the y axis."""
    return {
        "text": label(text), "x": x, "y": y, "xref": "paper", "yref": "y", "xanchor": "left",
        "yanchor": "middle", "showarrow": False, "font": {"size": 13},
    }  # fmt: skip
