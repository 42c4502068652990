"""Makes the elements of a report's pictures, in the format of the library plotly.

The pictures are plain lists and dicts, which `page.py` encodes as JSON. Columns of numbers are
doubles in base64, because JSON cannot represent NaN. Plotly reads this form. The colors in this
module suit a light and a dark background. `page.py` sets the colors of background, grid and text.
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

SOURCE_COLOURS = (
    "#159a6b", "#2f6fd8", "#b04fc4", "#8f4f22", "#1ab2d2", "#8a8f00", "#e0588c", "#4a2f8f",
)  # fmt: skip
"""Colors of the command sources that drive the robot. Successive colors are easy to distinguish."""

FILL_PATTERNS = ("", "/", "x", ".", "-")
"""Fill patterns of the bands of the command sources that drive the robot.

The first sources have the first pattern and different colors. When all colors are used, they are
used again with the next pattern.
"""


def source_style(number: int) -> tuple[str, str]:
    """Return the pair (color, fill pattern) for the bands in which a command source drives.

    `number` counts the sources that drive, from 0.
    """
    beyond, place = divmod(number, len(SOURCE_COLOURS))
    return SOURCE_COLOURS[place], FILL_PATTERNS[beyond % len(FILL_PATTERNS)]


WRAP_COLUMNS = 42
"""Maximum length of a line in the text that appears at the pointer, characters. A line of this
length fits on a phone."""

Trace = dict[str, Any]
"""One curve, or one set of marks or bars, as plotly describes it."""


class Key(NamedTuple):
    """An entry of a picture's legend."""

    sign: str
    """Symbol, such as "●"."""
    colour: str
    """CSS color of the symbol."""
    meaning: str
    """Words beside the symbol."""


class Figure(NamedTuple):
    """A picture of the report."""

    name: str
    """Id of the picture in the page."""
    title: str
    caption: str
    keys: list[Key]
    """The legend."""
    height: int
    """Height, px."""
    data: list[Trace]
    layout: dict[str, Any]
    """Axes, margins and titles, as plotly describes them."""
    timed: bool = True
    """True if the x axis of the picture is the time.

    If the user zooms such a picture, the page zooms all pictures with a time axis.
    """


def label(text: str) -> str:
    """Return a text for plotly: escaped, and wrapped to lines of at most `WRAP_COLUMNS`
    characters."""
    lines = textwrap.wrap(printable(text), WRAP_COLUMNS) or [""]
    return "<br>".join(html.escape(line) for line in lines)


def numbers(values: Iterable[float]) -> dict[str, str]:
    """Return a column of numbers in a form that plotly reads: as doubles in base64."""
    data = struct.pack(f"<{len(values := list(values))}d", *values)
    return {"dtype": "f8", "bdata": binascii.b2a_base64(data, newline=False).decode()}


def scatter(name: str, x: Iterable[float], y: Iterable[float], **attributes: object) -> Trace:
    """Return a curve, or a set of marks, through points with the coordinates `x` and `y`.

    `name` is the name of the curve. `attributes` are further attributes of plotly's `scatter`.
    """
    return {"type": "scatter", "name": name, "x": numbers(x), "y": numbers(y), **attributes}


def sentence(mark: Mark) -> str:
    """Return the escaped text that the page shows when the user points at an event."""
    head = f"<b>{label(mark.name.replace('_', ' '))}</b>"
    by = [label(f"by {mark.by}")] if mark.by else []
    return "<br>".join([head, label(mark.text_with_count), *by])


def layout() -> dict[str, Any]:
    """Return the part of the layout that all pictures share."""
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
    """Return a title that is written into a picture.

    Args:
        text: the title, not escaped.
        x: the left edge of the title, as a fraction of the picture's width.
        y: the middle of the title, as a value on the y axis.
    """
    return {
        "text": label(text), "x": x, "y": y, "xref": "paper", "yref": "y", "xanchor": "left",
        "yanchor": "middle", "showarrow": False, "font": {"size": 13},
    }  # fmt: skip
