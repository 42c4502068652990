"""The picture of the path."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

from acsard.report.course import Course, Marks
from acsard.report.drawing import (
    COLOURS,
    END,
    LIMITED,
    MEASURED,
    Figure,
    Key,
    Trace,
    layout,
    numbers,
    sentence,
)
from acsard.thinning import Place

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
    """Draw the path with its events."""
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
        "By odometry, both axes in m and equal."
        if places
        else "No feedback that could be believed: nothing is known of where it went."
    )
    return Figure("path", "The path", caption, keys, 460, data, axes, timed=False)


def _noted(name: str, marks: Marks, dot: dict[str, Any]) -> Trace | None:
    """Draw the events of one name at their places, or return None without any."""
    marks_here = [mark for mark in marks.all() if mark.name == name]
    here = [(mark, mark.place) for mark in marks_here if mark.place is not None]
    if not here:
        return None
    trace = _places(name.replace("_", " "), [at for _, at in here], "markers", marker=dot)
    words = [sentence(mark) for mark, _ in here]
    return trace | {"hovertext": words, "hovertemplate": "%{hovertext}<extra></extra>"}


def _places(name: str, places: list[Place], mode: str, **look: object) -> Trace:
    return {
        "type": "scatter",
        "mode": mode,
        "name": name,
        "x": numbers(place.x for place in places),
        "y": numbers(place.y for place in places),
        "hovertemplate": f"{name}: x %{{x:.3f}} m, y %{{y:.3f}} m<extra></extra>",
        **look,
    }


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
