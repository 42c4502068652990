"""Elements of the pictures in the format of the library plotly, and the picture of the path.

The pictures are plain lists and dicts. Numbers are doubles in base64, because plotly reads them and
JSON cannot represent NaN. The colours of paper, grid and text are set by the page (`page.py`). The
colours here suit a light and a dark background.
"""

from __future__ import annotations

import binascii
import html
import math
import struct
import textwrap
from collections.abc import Iterable
from itertools import pairwise
from typing import Any, NamedTuple

from acsard.core.formatting import printable
from acsard.core.thinning import Place
from acsard.report.course import Course, Mark, Marks

WISHED, LIMITED, MEASURED = "#e08600", "#2f7ed8", "#159a6b"

END = "#8668b8"

COLOURS = {
    "driving": "#159a6b", "ready": "#8fb8de", "waiting": "#e0b400", "stopped": "#e08600",
    "fault": "#d43d3d", "inactive": "#9a9a9a", "shutdown": END,
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
    """Escape any text for plotly and wrap it to lines that fit on a phone."""
    lines = textwrap.wrap(printable(text), 42) or [""]
    return "<br>".join(html.escape(line) for line in lines)


def numbers(values: Iterable[float]) -> dict[str, str]:
    """Encode a column of numbers as doubles in base64."""
    data = struct.pack(f"<{len(values := list(values))}d", *values)
    return {"dtype": "f8", "bdata": binascii.b2a_base64(data, newline=False).decode()}


def scatter(name: str, x: Iterable[float], y: Iterable[float], **look: object) -> Trace:
    """Return a curve, or a mark at each place."""
    return {"type": "scatter", "name": name, "x": numbers(x), "y": numbers(y), **look}


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


HEADINGS = 12
"""Approximate number of heading arrows along a path."""

NOTED = {
    "fault": ("✖", "x", COLOURS["error"]),
    "stop": ("◆", "diamond", COLOURS["warning"]),
    "link_down": ("▼", "triangle-down", "#b04fc4"),
    "link_stale": ("▲", "triangle-up", "#e0b400"),
    "link_late": ("⬟", "pentagon", "#8f4f22"),
}
"""Events that are drawn on the path: legend symbol, plotly's name of the symbol, and colour."""


def path(course: Course) -> Figure:
    places = course.path.places()
    keys: list[Key] = []
    data: list[Trace] = []
    if places:
        arrows = _spread(places)
        data = [
            _places("path", _broken(places), "lines", line={"color": LIMITED, "width": 2.5}),
            _places("heading", arrows, "markers", marker=_arrows(arrows)),
            _places("start", places[:1], "markers", marker=_dot("circle", MEASURED, 14)),
            _places("end", places[-1:], "markers", marker=_dot("square", END, 13)),
        ]
        keys = [Key("▶", LIMITED, "heading"), Key("●", MEASURED, "start"), Key("■", END, "end")]
    for name, (sign, symbol, colour) in NOTED.items():
        trace = _noted(name, course.marks, _dot(symbol, colour, 12))
        if trace:
            data.append(trace)
            keys.append(Key(sign, colour, trace["name"]))
    axes = layout() | {
        "xaxis": {"title": {"text": "x, m"}, "automargin": True},
        "yaxis": {"title": {"text": "y, m"}, "scaleanchor": "x", "scaleratio": 1},
        "margin": {"l": 58, "r": 12, "t": 8, "b": 48},
    }
    caption = (
        "By odometry; both axes are in m and have the same scale."
        if places
        else "There is no valid feedback, so the path is unknown."
    )
    return Figure("path", "The path", caption, keys, 460, data, axes, timed=False)


def _noted(name: str, marks: Marks, dot: dict[str, Any]) -> Trace | None:
    """Draw the events of one name at their places, or return None without any."""
    marks_here = [mark for mark in marks.all() if mark.name == name]
    here = [(mark, mark.place) for mark in marks_here if mark.place is not None]
    if not here:
        return None
    trace = _places(name.replace("_", " "), [at for _, at in here], "markers", marker=dot)
    del trace["hovertemplate"]
    return trace | {"hovertext": [sentence(mark) for mark, _ in here], "hoverinfo": "text"}


def _places(name: str, places: list[Place], mode: str, **look: object) -> Trace:
    hover = f"{name}: x %{{x:.3f}} m, y %{{y:.3f}} m<extra></extra>"
    x, y = [place.x for place in places], [place.y for place in places]
    return scatter(name, x, y, mode=mode, hovertemplate=hover, **look)


def _broken(places: list[Place]) -> list[Place]:
    """Insert a gap where the pose was set."""
    gap = Place(0.0, math.nan, math.nan, 0.0)
    found = [one for place in places for one in ((gap, place) if place.new else (place,))]
    return found[1:] if found and found[0] is gap else found


def _spread(places: list[Place]) -> list[Place]:
    """Return about `HEADINGS` places at equal distances along the path."""
    ways = [0.0]
    for one, other in pairwise(places):
        step = 0.0 if other.new else math.hypot(other.x - one.x, other.y - one.y)
        ways.append(ways[-1] + step)
    every, found, due = ways[-1] / HEADINGS, list[Place](), 0.0
    for place, way in zip(places, ways, strict=True):
        if way >= due and (not found or way > 0):
            found.append(place)
            due += max(every, way - due)
    return found


def _arrows(places: list[Place]) -> dict[str, Any]:
    """Return markers along the heading. Plotly's angles are in degrees clockwise from up."""
    angles = [round(90 - math.degrees(place.yaw), 2) for place in places]
    return {"symbol": "arrow", "size": 13, "color": LIMITED, "angle": angles}


def _dot(symbol: str, colour: str, size: int) -> dict[str, Any]:
    return {"symbol": symbol, "size": size, "color": colour}
