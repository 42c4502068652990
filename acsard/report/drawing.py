"""Elements of the pictures in the format of the library plotly: plain lists and dicts.

Numbers are doubles in base64, because plotly reads them and JSON cannot represent NaN. The colours
of paper, grid and text are set by the page (`look.py`). The colours here suit a light and a dark
background.
"""

from __future__ import annotations

import binascii
import html
import struct
import textwrap
from collections.abc import Iterable
from typing import Any, NamedTuple

from acsard.formatting import printable
from acsard.report.course import Mark

WISHED, LIMITED, MEASURED = "#e08600", "#2f7ed8", "#159a6b"

END = "#8668b8"

COLOURS = {
    "driving": "#159a6b", "ready": "#8fb8de", "waiting": "#e0b400", "stopped": "#e08600",
    "fault": "#d43d3d", "inactive": "#9a9a9a", "leaving": END,
    "up": "#8fb8de", "booting": "#e0b400", "stale": "#e08600", "down": "#d43d3d",
    "drives": "#159a6b", "sends": "#8fb8de", "waits": "#e0b400", "refused": "#d43d3d",
    "info": "#2f7ed8", "warning": "#e08600", "error": "#d43d3d",
}  # fmt: skip

UNKNOWN = "#9a9a9a"

COMMANDERS = (
    "#159a6b", "#2f6fd8", "#b04fc4", "#8f4f22", "#1ab2d2", "#8a8f00", "#e0588c", "#4a2f8f",
)  # fmt: skip
"""Colours of the driving sources; neighbours in the list are easy to tell apart."""

PATTERNS = ("", "/", "x", ".", "-")
"""Fill patterns. When the colours are used up, they repeat with the next pattern."""


def commander(number: int) -> tuple[str, str]:
    """Return the colour and the pattern of the n-th driving source."""
    beyond, place = divmod(number, len(COMMANDERS))
    return COMMANDERS[place], PATTERNS[beyond % len(PATTERNS)]


WRAP = 42
"""Line length in characters that fits on a phone."""

Trace = dict[str, Any]


class Key(NamedTuple):
    """An entry of a legend: symbol, colour and meaning."""

    sign: str
    colour: str
    meaning: str


class Figure(NamedTuple):
    name: str
    title: str
    caption: str
    keys: list[Key]
    height: int
    """Height in px."""
    data: list[Trace]
    layout: dict[str, Any]
    timed: bool = True
    """True if the x axis is time; zooming one such picture zooms all of them."""


def label(text: str) -> str:
    """Escape any text for plotly and wrap it to short lines."""
    lines = textwrap.wrap(printable(text), WRAP) or [""]
    return "<br>".join(html.escape(line) for line in lines)


def numbers(values: Iterable[float]) -> dict[str, str]:
    """Encode a column of numbers as doubles in base64."""
    data = struct.pack(f"<{len(values := list(values))}d", *values)
    return {"dtype": "f8", "bdata": binascii.b2a_base64(data, newline=False).decode()}


def sentence(mark: Mark) -> str:
    """Return the hover text of an event."""
    head = f"<b>{label(mark.name.replace('_', ' '))}</b>"
    by = [label(f"by {mark.by}")] if mark.by else []
    return "<br>".join([head, label(mark.text), *by])


def layout() -> dict[str, Any]:
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
    """Return a heading inside a picture, where it needs no margin."""
    return {
        "text": label(text), "x": x, "y": y, "xref": "paper", "yref": "y", "xanchor": "left",
        "yanchor": "middle", "showarrow": False, "font": {"size": 13},
    }  # fmt: skip
