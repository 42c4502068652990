"""The pictures of a course, as the library plotly wants them: plain lists and dicts.

Time is on the x axis of most, in ms since 1970 by the clock on the wall here: the library knows no
time zones. Numbers are doubles in base64, which the library reads and JSON has no word for NaN.
The colours of paper, grid and text are the page's (`look.py`); those here suit light and dark.
"""

from __future__ import annotations

import binascii
import html
import math
import struct
import textwrap
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from acsard.messages.text import printable
from acsard.report.commanders import OTHERS
from acsard.report.course import Course, Mark
from acsard.report.thinning import Curve, Place, Point, Span
from acsard.values import WHEELS

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

ROW_PX, ROOM_PX = 54, 60
"""Height of a row of bands, and what the time axis takes beside the rows."""

WRAP = 42
"""Characters of a line that fits on a phone."""

HEADINGS = 12
"""Arrows along a path."""

NOTED = ("fault", "stop", "link_down", "link_stale")
"""Events that the path shows where they happened."""

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


class Line(NamedTuple):
    """A curve of a picture, and how it goes from one value to the next."""

    name: str
    colour: str
    points: Sequence[Point]
    shape: str = "linear"


class Part(NamedTuple):
    """One of several pictures above one time axis."""

    title: str
    lines: list[Line]


def label(text: str) -> str:
    """A text by whomever as the library shows it: as it is, on short lines."""
    lines = textwrap.wrap(printable(text), WRAP) or [""]
    return "<br>".join(html.escape(line) for line in lines)


def numbers(values: Iterable[float]) -> dict[str, str]:
    """A column of doubles."""
    data = struct.pack(f"<{len(values := list(values))}d", *values)
    return {"dtype": "f8", "bdata": binascii.b2a_base64(data, newline=False).decode()}


class Pictures:
    """Draws a course; `offset_s` is what the clocks here are ahead of UTC."""

    def __init__(self, course: Course, offset_s: float) -> None:
        self._course = course
        self._zero_ms = 1000 * ((course.began or 0.0) + offset_s)

    def all(self) -> list[Figure]:
        """In the order of the page."""
        return [
            self.path(), self.speeds(), self.who(), self.events(), self.wheels(), self.link(),
            self.loop(),
        ]  # fmt: skip

    def path(self) -> Figure:
        """Where it went."""
        places = self._course.path.places()
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
        for name in NOTED:
            trace = self._noted(name)
            if trace:
                data.append(trace)
                keys.append(Key("✖", trace["marker"]["color"], trace["name"]))
        layout = _layout() | {
            "xaxis": {"title": {"text": "x, m"}, "automargin": True},
            "yaxis": {"title": {"text": "y, m"}, "scaleanchor": "x", "scaleratio": 1},
            "margin": {"l": 58, "r": 12, "t": 8, "b": 48},
        }
        caption = (
            "By odometry, both axes in m and equal."
            if places
            else "No feedback that could be believed: nothing is known of where it went."
        )
        return Figure("path", "The path", caption, keys, 460, data, layout, timed=False)

    def _noted(self, name: str) -> Trace | None:
        """Where these events happened."""
        marks = [mark for mark in self._course.marks.all() if mark.name == name]
        here = [(mark, mark.place) for mark in marks if mark.place is not None]
        if not here:
            return None
        dot = _dot("x", COLOURS["error" if name == "fault" else "warning"], 11)
        trace = _places(name.replace("_", " "), [at for _, at in here], "markers", marker=dot)
        words = [sentence(mark) for mark, _ in here]
        return trace | {"hovertext": words, "hovertemplate": "%{hovertext}<extra></extra>"}

    def speeds(self) -> Figure:
        """What was wished, allowed and measured."""
        course = self._course
        parts = [
            Part(
                title,
                [
                    Line("wished", WISHED, curves["wished"].points(), "hv"),
                    Line("limited", LIMITED, curves["limited"].points(), "hv"),
                    Line("measured", MEASURED, curves["measured"].points()),
                ],
            )
            for title, curves in (
                ("forward, m/s", course.linear),
                ("turning, rad/s", course.angular),
            )
        ]
        caption = (
            "Wished by who is followed; limited is what was asked of the wheels; measured is what "
            "they said. Turning left and driving forward are above zero."
        )
        return self._stack("speeds", "Speed", caption, parts, 210)

    def wheels(self) -> Figure:
        """What each wheel was asked, and what it said."""
        pairs = zip(WHEELS, self._course.asked, self._course.turned, strict=True)
        parts = [
            Part(
                f"{name.replace('_', ' ')}, rad/s",
                [
                    Line("asked", LIMITED, asked.points(), "hv"),
                    Line("measured", MEASURED, turned.points()),
                ],
            )
            for name, asked, turned in pairs
        ]
        caption = "Above zero drives the robot forward."
        return self._stack("wheels", "The four wheels", caption, parts, 150)

    def link(self) -> Figure:
        """Lines a second."""
        link = self._course.link
        bad = [Line("dropped", COLOURS["error"], link.dropped.points(), "hvh")]
        if not self._course.config.mcu.reply_period:
            bad.append(Line("no answer", WISHED, link.unanswered.points(), "hvh"))
        parts = [
            Part(
                "lines a second",
                [
                    Line("sent", LIMITED, link.sent.points(), "hvh"),
                    Line("answered", MEASURED, link.good.points(), "hvh"),
                ],
            ),
            Part("lost a second", bad),
        ]
        caption = (
            "Dropped lines came and could not be read or believed; those without an answer are "
            "lost on the way there or back."
        )
        return self._stack("link", "The serial line", caption, parts, 170)

    def loop(self) -> Figure:
        """How late it was."""
        late = Line("late", LIMITED, self._course.lateness.points(), "hv")
        caption = "From when a period was due to its step, against the one that was least late."
        return self._stack("loop", "The control loop", caption, [Part("late, ms", [late])], 200)

    def who(self) -> Figure:
        """Mode, link and sources as bands."""
        course, silent = self._course, list[str]()
        rows: list[tuple[str, list[Span]]] = [
            ("mode", course.modes.spans()),
            ("link", course.links.spans()),
        ]
        for name, band in course.commanders.bands.items():
            if band.spans():
                rows.append((name, band.spans()))
            elif name != OTHERS:
                silent.append(name)
        kinds = dict.fromkeys(span.kind for _, spans in rows for span in spans)
        data = [
            self._bars(
                kind,
                [(at, s) for at, (_, spans) in enumerate(rows) for s in spans if s.kind == kind],
            )
            for kind in kinds
        ]
        keys = [Key("■", COLOURS.get(kind, UNKNOWN), kind) for kind in kinds]
        layout = self._timed() | {
            "barmode": "overlay",
            "uniformtext": {"mode": "hide", "minsize": 11},
            "yaxis": {"range": [len(rows) - 0.45, -0.75], "visible": False, "fixedrange": True},
            "annotations": [_note(name, 0, at - 0.44) for at, (name, _) in enumerate(rows)],
        }
        caption = "Point at a band to read why. A source waits while another one before it sends."
        if silent:
            caption += f" Silent all the time: {', '.join(silent)}."
        height = ROW_PX * len(rows) + ROOM_PX
        return Figure(
            "who", "Who drove, and why others did not", caption, keys, height, data, layout
        )

    def _bars(self, kind: str, spans: list[tuple[int, Span]]) -> Trace:
        colour = COLOURS.get(kind, UNKNOWN)
        return {
            "type": "bar",
            "orientation": "h",
            "name": label(kind),
            "base": numbers(self._ms(span.begin) for _, span in spans),
            "x": numbers(1000 * (span.end - span.begin) for _, span in spans),
            "y": numbers(at for at, _ in spans),
            "width": 0.5,
            # However short it is, a line of it is seen.
            "marker": {"color": colour, "line": {"color": colour, "width": 1}},
            "hovertext": [f"<b>{label(kind)}</b><br>{label(span.words)}" for _, span in spans],
            "hovertemplate": "%{hovertext}<extra></extra>",
            "text": [kind for _ in spans],
            "textposition": "inside",
            "insidetextanchor": "middle",
            "textangle": 0,
        }

    def events(self) -> Figure:
        """All events as marks."""
        levels, kept = ("info", "warning", "error"), self._course.marks
        data = [
            self._marks(level, at, [mark for mark in kept.all() if mark.level == level])
            for at, level in enumerate(levels)
        ]
        layout = self._timed() | {
            "yaxis": {"range": [-0.5, len(levels)], "visible": False, "fixedrange": True},
            "annotations": [_note(level, 0, at + 0.42) for at, level in enumerate(levels)],
        }
        caption = "Point at a mark to read it; the list is at the end."
        keys = [Key("◆", COLOURS[level], level) for level in reversed(levels)]
        return Figure("events", "Events", caption, keys, 230, data, layout)

    def _marks(self, level: str, at: int, marks: list[Mark]) -> Trace:
        return {
            "type": "scatter",
            "mode": "markers",
            "name": level,
            "x": numbers(self._ms(mark.t) for mark in marks),
            "y": numbers(at for _ in marks),
            "marker": {"symbol": "diamond", "size": 11, "color": COLOURS[level]},
            "hovertext": [sentence(mark) for mark in marks],
            "hovertemplate": "%{hovertext}<extra></extra>",
        }

    # what is alike in them

    def _ms(self, t: float) -> float:
        return self._zero_ms + 1000 * t

    def _timed(self) -> dict[str, Any]:
        seconds = max(self._course.seconds, 0.1)
        axis = {"type": "date", "range": [self._ms(-0.01 * seconds), self._ms(1.01 * seconds)]}
        return _layout() | {"xaxis": axis, "margin": {"l": 44, "r": 12, "t": 8, "b": 36}}

    def _stack(self, name: str, title: str, caption: str, parts: list[Part], px: int) -> Figure:
        """Pictures above each other, with one time axis and one legend."""
        layout, data, notes = self._timed(), list[Trace](), list[dict[str, Any]]()
        share, gap = 1 / len(parts), 30 / (px * len(parts))
        for at, part in enumerate(parts):
            top, n = 1 - at * share, "" if not at else str(at + 1)
            layout[f"yaxis{n}"] = {"domain": [top - share, top - gap], "rangemode": "tozero"}
            where = {"xref": "paper", "yref": "paper", "yanchor": "bottom"}
            notes.append(_note(part.title, 0, top - gap) | where)
            data += [self._line(line, f"y{n}") for line in part.lines]
        layout["xaxis"]["anchor"] = f"y{len(parts)}" if len(parts) > 1 else "y"
        layout["annotations"] = notes
        lines = dict.fromkeys((line.name, line.colour) for part in parts for line in part.lines)
        keys = [Key("━", colour, meaning) for meaning, colour in lines]
        return Figure(name, title, caption, keys, px * len(parts) + 70, data, layout)

    def _line(self, line: Line, axis: str) -> Trace:
        return {
            "type": "scatter",
            "mode": "lines",
            "name": line.name,
            "x": numbers(self._ms(point.t) for point in line.points),
            "y": numbers(point.value for point in line.points),
            "yaxis": axis,
            "line": {"color": line.colour, "width": 1.6, "shape": line.shape},
            "hovertemplate": f"{line.name} %{{y:.3~f}}<br>%{{x|%H:%M:%S.%L}}<extra></extra>",
        }


def sentence(mark: Mark) -> str:
    """An event for who points at it."""
    head = f"<b>{label(mark.name.replace('_', ' '))}</b>"
    by = [label(f"by {mark.by}")] if mark.by else []
    return "<br>".join([head, label(mark.text), *by])


def width_s(course: Course) -> float:
    """s that one point of a picture stands for at most."""
    curves: list[Curve] = [*course.linear.values(), *course.angular.values()]
    return max(curve.width for curve in curves)


def _layout() -> dict[str, Any]:
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


def _note(text: str, x: float, y: float) -> dict[str, Any]:
    """A heading within a picture: it takes no room beside it."""
    return {
        "text": label(text), "x": x, "y": y, "xref": "paper", "yref": "y", "xanchor": "left",
        "yanchor": "middle", "showarrow": False, "font": {"size": 13},
    }  # fmt: skip


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
    """With a gap where it was set elsewhere."""
    gap = Place(0.0, math.nan, math.nan, 0.0)
    found = [one for place in places for one in ((gap, place) if place.new else (place,))]
    return found[1:] if found and found[0] is gap else found


def _spread(places: list[Place]) -> list[Place]:
    """Some of them, as far from each other by way as can be."""
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
    """The library's angles are in degrees from up, clockwise."""
    angles = [round(90 - math.degrees(place.yaw), 2) for place in places]
    return {"symbol": "arrow", "size": 13, "color": LIMITED, "angle": angles}


def _dot(symbol: str, colour: str, size: int) -> dict[str, Any]:
    return {"symbol": symbol, "size": size, "color": colour}
