"""Draws the path of the robot, with the events at their places."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

from acsard.core.thinning import Place
from acsard.report.plot_elements import (
    COLOURS,
    END,
    LIMITED,
    MEASURED,
    Figure,
    Key,
    Trace,
    layout,
    scatter,
    sentence,
)
from acsard.report.report_data import Marks, ReportData

HEADINGS = 12
"""Approximate number of heading arrows along a path."""

NOTED = {
    "fault": ("✖", "x", COLOURS["error"]),
    "stop": ("◆", "diamond", COLOURS["warning"]),
    "link_down": ("▼", "triangle-down", "#b04fc4"),
    "link_stale": ("▲", "triangle-up", "#e0b400"),
    "link_late": ("⬟", "pentagon", "#8f4f22"),
}
"""Events that are drawn on the path: symbol in the legend, plotly's name of the symbol, colour."""


def path_figure(data: ReportData) -> Figure:
    """Draw the path with its events."""
    places = data.path.places()
    keys: list[Key] = []
    traces: list[Trace] = []
    if places:
        arrows = _spread(places)
        traces = [
            _places("path", _with_gaps(places), "lines", line={"color": LIMITED, "width": 2.5}),
            _places("heading", arrows, "markers", marker=_arrows(arrows)),
            _places("start", places[:1], "markers", marker=_dot("circle", MEASURED, 14)),
            _places("end", places[-1:], "markers", marker=_dot("square", END, 13)),
        ]
        keys = [Key("▶", LIMITED, "heading"), Key("●", MEASURED, "start"), Key("■", END, "end")]
    for name, (sign, symbol, colour) in NOTED.items():
        trace = _events(name, data.marks, _dot(symbol, colour, 12))
        if trace:
            traces.append(trace)
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
    return Figure("path", "The path", caption, keys, 460, traces, axes, timed=False)


def _events(name: str, marks: Marks, dot: dict[str, Any]) -> Trace | None:
    """Draw the events of one name at their places; return None if no such event has a place."""
    named = [mark for mark in marks.all() if mark.name == name]
    placed = [(mark, mark.place) for mark in named if mark.place is not None]
    if not placed:
        return None
    trace = _places(name.replace("_", " "), [place for _, place in placed], "markers", marker=dot)
    del trace["hovertemplate"]
    return trace | {"hovertext": [sentence(mark) for mark, _ in placed], "hoverinfo": "text"}


def _places(name: str, places: list[Place], mode: str, **look: object) -> Trace:
    hover = f"{name}: x %{{x:.3f}} m, y %{{y:.3f}} m<extra></extra>"
    x, y = [place.x for place in places], [place.y for place in places]
    return scatter(name, x, y, mode=mode, hovertemplate=hover, **look)


def _with_gaps(places: list[Place]) -> list[Place]:
    """Insert a gap before each place that does not continue the path."""
    gap = Place(0.0, math.nan, math.nan, 0.0)
    found = [item for place in places for item in ((gap, place) if place.new else (place,))]
    return found[1:] if found and found[0] is gap else found


def _spread(places: list[Place]) -> list[Place]:
    """Return about `HEADINGS` places at equal distances along the path."""
    distances = [0.0]
    for before, after in pairwise(places):
        metres = 0.0 if after.new else math.hypot(after.x - before.x, after.y - before.y)
        distances.append(distances[-1] + metres)
    spacing, found, due = distances[-1] / HEADINGS, list[Place](), 0.0
    for place, distance in zip(places, distances, strict=True):
        if distance >= due and (not found or distance > 0):
            found.append(place)
            due += max(spacing, distance - due)
    return found


def _arrows(places: list[Place]) -> dict[str, Any]:
    """Return markers that point along the heading."""
    # Plotly's angles are in degrees, clockwise from up.
    angles = [round(90 - math.degrees(place.yaw), 2) for place in places]
    return {"symbol": "arrow", "size": 13, "color": LIMITED, "angle": angles}


def _dot(symbol: str, colour: str, size: int) -> dict[str, Any]:
    return {"symbol": symbol, "size": size, "color": colour}
