"""What the pictures are made of, as the library plotly wants it: plain lists and dicts.

Numbers are doubles in base64, which the library reads and JSON has no word for NaN. The colours of
paper, grid and text are the page's (`look.py`); those here suit light and dark.
"""

from __future__ import annotations

import binascii
import html
import struct
import textwrap
from collections.abc import Iterable
from typing import Any, NamedTuple

from acsard.messages.text import printable
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
"""Who drives: told apart also beside each other."""

PATTERNS = ("", "/", "x", ".", "-")
"""For who comes after so many: the same colours, hatched."""


def commander(number: int) -> tuple[str, str]:
    """The colour and the pattern of the n-th who drives."""
    beyond, place = divmod(number, len(COMMANDERS))
    return COMMANDERS[place], PATTERNS[beyond % len(PATTERNS)]


WRAP = 42
"""Characters of a line that fits on a phone."""

Trace = dict[str, Any]


class Key(NamedTuple):
    """A sign of a picture, its colour, and what it means."""

    sign: str
    colour: str
    meaning: str


class Figure(NamedTuple):
    name: str
    title: str
    caption: str
    keys: list[Key]
    height: int
    """px"""
    data: list[Trace]
    layout: dict[str, Any]
    timed: bool = True
    """Its x axis is time: who looks closer at it wants the others to follow."""


def label(text: str) -> str:
    """A text by whomever as the library shows it: as it is, on short lines."""
    lines = textwrap.wrap(printable(text), WRAP) or [""]
    return "<br>".join(html.escape(line) for line in lines)


def numbers(values: Iterable[float]) -> dict[str, str]:
    """A column of doubles."""
    data = struct.pack(f"<{len(values := list(values))}d", *values)
    return {"dtype": "f8", "bdata": binascii.b2a_base64(data, newline=False).decode()}


def sentence(mark: Mark) -> str:
    """An event for who points at it."""
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
    """A heading within a picture: it takes no room beside it."""
    return {
        "text": label(text), "x": x, "y": y, "xref": "paper", "yref": "y", "xanchor": "left",
        "yanchor": "middle", "showarrow": False, "font": {"size": 13},
    }  # fmt: skip
