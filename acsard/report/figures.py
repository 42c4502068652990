"""Draws the pictures of a report: the path of the robot, and all other data over time.

Times are ms since 1970 in local time, because plotly does not know time zones.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from acsard.core.thinning import Place, Point, Span
from acsard.core.values import WHEELS
from acsard.report.command_sources import OTHER_SOURCES
from acsard.report.plot_elements import (
    COLOURS,
    COMMANDED,
    END_COLOUR,
    LIMITED,
    MEASURED,
    UNKNOWN_COLOUR,
    Figure,
    Key,
    Trace,
    label,
    layout,
    note,
    numbers,
    scatter,
    sentence,
    source_style,
)
from acsard.report.report_data import Mark, Marks, ReportData


class Line(NamedTuple):
    """A curve in a diagram."""

    name: str
    colour: str
    points: Sequence[Point]
    shape: str = "linear"  # plotly's `line.shape`
    width: float = 1.6  # px
    values: Sequence[float] = ()  # shown at the pointer, if not those of `points`


GAP_PX = 30  # above each diagram, for its title

UNDER_CURVE_PX = 3.4  # wider than the curve above it, so visible on both sides


class Clip(NamedTuple):
    """A time in which a curve exceeds its diagram's scale, and is drawn at the edge."""

    t: float  # begin, s of the report
    edge: float  # of the diagram
    value: float  # furthest beyond the edge


# Fraction of the width: closer excursions over an edge are one, with one triangle.
MIN_MARK_DISTANCE = 0.02

# Leave space for a commanded speed that the robot reaches only after a ramp. Limit this space, so
# that a command of 99 m/s does not flatten the other curves.
HEADROOM = 0.5  # above and below the limited and measured speeds, as a fraction of their span


def clipped(
    points: Sequence[Point], others: Sequence[Sequence[Point]], least: float, gap: float
) -> tuple[list[Point], list[Clip]]:
    """Limit a curve to the scale of the others, and return its points and excursions.

    The scale has `HEADROOM` and covers at least `least`. Excursions over an edge within `gap` s are
    one.
    """
    values = [0.0, *(p.value for curve in others for p in curve if math.isfinite(p.value))]
    room = HEADROOM * max(max(values) - min(values), least)
    low, high = min(values) - room, max(values) + room
    drawn, clips, outside = list[Point](), list[Clip](), -math.inf
    for t, value in points:
        edge = min(max(value, low), high) if math.isfinite(value) else value
        drawn.append(Point(t, edge))
        if edge == value or math.isnan(value):
            continue
        if clips and edge == clips[-1].edge and t <= outside + gap:
            clips[-1] = clips[-1]._replace(value=max(clips[-1].value, value, key=abs))
        else:
            clips.append(Clip(t, edge, value))
        outside = t
    return drawn, clips


class Part(NamedTuple):
    """A diagram in a picture, where all share the time axis."""

    title: str
    lines: list[Line]
    beyond: Sequence[Clip] = ()  # excursions of the first line


Row = tuple[str, list[Span]]  # of the picture of the command sources: name, and bands


class BandStyle(NamedTuple):
    """Color and pattern of the bands of one state; each source that drives has its own."""

    kind: str  # state, such as "waits"
    source: str  # that drives; "" for all rows
    colour: str
    pattern: str = ""  # one of `FILL_PATTERNS`

    @property
    def meaning(self) -> str:
        """Words for the legend, such as "joystick drives" or "waits"."""
        return f"{self.source} {self.kind}".strip()

    def of(self, row: Row) -> list[Span]:
        """Return the spans of a row with this style."""
        name, spans = row
        applies = self.source in ("", name)
        return [span for span in spans if span.kind == self.kind] if applies else []


def _styles(rows: list[Row]) -> Iterator[BandStyle]:
    drivers = [name for name, spans in rows if any(span.kind == "drives" for span in spans)]
    for kind in dict.fromkeys(span.kind for _, spans in rows for span in spans):
        if kind == "drives":
            for number, name in enumerate(drivers):
                yield BandStyle(kind, name, *source_style(number))
        else:
            yield BandStyle(kind, "", COLOURS.get(kind, UNKNOWN_COLOUR))


def _keys(styles: list[BandStyle]) -> list[Key]:
    meanings: dict[tuple[str, str], list[str]] = {}
    for style in styles:
        meanings.setdefault((style.colour, style.pattern), []).append(style.meaning)
    return [
        Key("▨" if pattern else "■", colour, ", ".join(texts))
        for (colour, pattern), texts in meanings.items()
    ]


# Approximate number of arrows along the path.
HEADING_ARROWS = 12

# Marks by event: symbol in the legend, plotly's name, color.
EVENT_MARKS = {
    "fault": ("✖", "x", COLOURS["error"]),
    "stop": ("◆", "diamond", COLOURS["warning"]),
    "emergency_stop": ("⬢", "hexagon", COLOURS["error"]),
    "bumper_pressed": ("■", "square", COLOURS["warning"]),
    "battery_stop": ("⬒", "square-open", COLOURS["error"]),
    "link_down": ("▼", "triangle-down", "#b04fc4"),
    "link_stale": ("▲", "triangle-up", "#e0b400"),
    "link_late": ("⬟", "pentagon", "#8f4f22"),
}


def path_figure(data: ReportData) -> Figure:
    """Return the picture of the path, with the events in `EVENT_MARKS`."""
    places = data.path.places()
    keys: list[Key] = []
    traces: list[Trace] = []
    if places:
        arrows = _spread(places)
        traces = [
            _places("path", _with_gaps(places), "lines", line={"color": LIMITED, "width": 2.5}),
            _places("heading", arrows, "markers", marker=_arrows(arrows)),
            _places("start", places[:1], "markers", marker=_dot("circle", MEASURED, 14)),
            _places("end", places[-1:], "markers", marker=_dot("square", END_COLOUR, 13)),
        ]
        keys = [
            Key("▶", LIMITED, "heading"),
            Key("●", MEASURED, "start"),
            Key("■", END_COLOUR, "end"),
        ]
    for name, (sign, symbol, colour) in EVENT_MARKS.items():
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
        "Odometry computed this path. Both axes are in m and have the same scale."
        if places
        else "There is no valid feedback, so the path is unknown."
    )
    return Figure("path", "The path", caption, keys, 460, traces, axes, timed=False)


def _events(name: str, marks: Marks, dot: dict[str, Any]) -> Trace | None:
    named = [mark for mark in marks.all() if mark.name == name]
    placed = [(mark, mark.place) for mark in named if mark.place is not None]
    if not placed:
        return None
    trace = _places(name.replace("_", " "), [place for _, place in placed], "markers", marker=dot)
    del trace["hovertemplate"]
    return trace | {"hovertext": [sentence(mark) for mark, _ in placed], "hoverinfo": "text"}


def _places(name: str, places: list[Place], mode: str, **attributes: object) -> Trace:
    hover = f"{name}: x %{{x:.3f}} m, y %{{y:.3f}} m<extra></extra>"
    x, y = [place.x for place in places], [place.y for place in places]
    return scatter(name, x, y, mode=mode, hovertemplate=hover, **attributes)


def _with_gaps(places: list[Place]) -> list[Place]:
    gap = Place(0.0, math.nan, math.nan, 0.0)
    items = [item for place in places for item in ((gap, place) if place.new else (place,))]
    return items[1:] if items and items[0] is gap else items


def _spread(places: list[Place]) -> list[Place]:
    # Places of the arrows, about equally far apart.
    distances = [0.0]
    for before, after in pairwise(places):
        metres = 0.0 if after.new else math.hypot(after.x - before.x, after.y - before.y)
        distances.append(distances[-1] + metres)
    spacing, arrows, due = distances[-1] / HEADING_ARROWS, list[Place](), 0.0
    for place, distance in zip(places, distances, strict=True):
        if distance >= due and (not arrows or distance > 0):
            arrows.append(place)
            due += max(spacing, distance - due)
    return arrows


def _arrows(places: list[Place]) -> dict[str, Any]:
    # Plotly's angles are in degrees, clockwise from up.
    angles = [round(90 - math.degrees(place.yaw), 2) for place in places]
    return {"symbol": "arrow", "size": 13, "color": LIMITED, "angle": angles}


def _dot(symbol: str, colour: str, size: int) -> dict[str, Any]:
    return {"symbol": symbol, "size": size, "color": colour}


class TimeFigures:
    """Draws the pictures of a report that have a time axis."""

    def __init__(self, data: ReportData, offset_s: float) -> None:
        # `offset_s` is local time minus UTC.
        self._data = data
        self._zero_ms = 1000 * ((data.began or 0.0) + offset_s)  # local time of the first step

    def all(self) -> list[Figure]:
        """Return all pictures in the order of the page."""
        return [
            path_figure(self._data), self.speeds(), self.sources(), self.events(), self.wheels(),
            self.serial(), self.loop(),
        ]  # fmt: skip

    def speeds(self) -> Figure:
        """Return the picture of the commanded, limited and measured speeds."""
        data, parts = self._data, list[Part]()
        gap = MIN_MARK_DISTANCE * data.seconds
        # The last number is the smallest range of the axis, which would otherwise be empty if the
        # robot never moves.
        for title, curves, least in (
            ("forward, m/s", data.linear, 0.1),
            ("turning, rad/s", data.angular, 0.2),
        ):
            wished, limited, measured = (
                curves[name].points() for name in ("commanded", "limited", "measured")
            )
            drawn, clips = clipped(wished, [limited, measured], least, gap)
            values = [point.value for point in wished] if clips else ()
            lines = [
                Line("commanded", COMMANDED, drawn, "hv", values=values),
                Line("limited", LIMITED, limited, "hv", UNDER_CURVE_PX),
                Line("measured", MEASURED, measured),
            ]
            parts.append(Part(title, lines, clips))
        caption = (
            "Commanded is the speed that the active source asks for. Limited is the speed sent to "
            "the wheels. Measured is the speed that the wheels reported. Left turns and forward "
            "driving are above zero."
        )
        furthest = [
            f"{max((clip.value for clip in part.beyond), key=abs):.4g} {part.title.split()[-1]}"
            for part in parts
            if part.beyond
        ]
        if furthest:
            caption += (
                " A triangle marks a commanded speed that is too large for the picture; the "
                f"largest of these is {' and '.join(furthest)}."
            )
        return self._stack("speeds", "Speed", caption, parts, 210)

    def wheels(self) -> Figure:
        """Return the picture of the commanded and measured speeds of the wheels."""
        curves = zip(WHEELS, self._data.commanded_wheels, self._data.measured_wheels, strict=True)
        parts = [
            Part(
                f"{name.replace('_', ' ')}, rad/s",
                [
                    Line("commanded", LIMITED, commanded.points(), "hv", UNDER_CURVE_PX),
                    Line("measured", MEASURED, measured.points()),
                ],
            )
            for name, commanded, measured in curves
        ]
        caption = "A speed above zero drives the robot forward."
        return self._stack("wheels", "The four wheels", caption, parts, 150)

    def serial(self) -> Figure:
        """Return the picture of the numbers of sent, received and lost serial lines."""
        counts, good = self._data.serial, "received"
        bad = [Line("dropped", COLOURS["error"], counts.dropped.curve.points(), "hvh")]
        caption = "Dropped lines arrived, but were unreadable or implausible."
        # If `reply_period` is set, the board reports by its own clock and answers no line.
        if not self._data.config.mcu.reply_period:
            good = "answered"
            bad.append(Line("no answer", COMMANDED, counts.unanswered.curve.points(), "hvh"))
            caption += " If a line has no answer, the line or its answer was lost."
        parts = [
            Part(
                "lines per second",
                [
                    Line("sent", LIMITED, counts.sent.curve.points(), "hvh", UNDER_CURVE_PX),
                    Line(good, MEASURED, counts.good.curve.points(), "hvh"),
                ],
            ),
            Part("lost per second", bad),
        ]
        return self._stack("link", "The serial line", caption, parts, 170)

    def loop(self) -> Figure:
        """Return the picture of the delays of the control loop."""
        late = Line("late", LIMITED, self._data.lateness.points(), "hv")
        caption = (
            "Each control step begins a little after it is due. This picture shows how much "
            "longer each step was delayed than the step with the shortest delay."
        )
        return self._stack("loop", "The control loop", caption, [Part("late, ms", [late])], 200)

    def sources(self) -> Figure:
        """Return the picture of the mode, the link and the states of the command sources."""
        data, silent = self._data, list[str]()
        rows: list[Row] = [
            ("mode", data.modes.spans()),
            ("link", data.links.spans()),
        ]
        for name, band in data.sources.bands.items():
            if band.spans():
                rows.append((name, band.spans()))
            elif name != OTHER_SOURCES:
                silent.append(name)
        styles = list(_styles(rows))
        traces = [
            self._bars(style, [(at, span) for at, row in enumerate(rows) for span in style.of(row)])
            for style in styles
        ]
        axes = self._timed() | {
            "barmode": "overlay",
            "uniformtext": {"mode": "hide", "minsize": 11},
            "yaxis": {"range": [len(rows) - 0.45, -0.75], "visible": False, "fixedrange": True},
            "annotations": [note(name, 0, at - 0.44) for at, (name, _) in enumerate(rows)],
        }
        caption = (
            "Point at a band to read the reason. A source waits, for example, while a source with "
            "a higher priority sends, or until it has sent a zero."
        )
        if silent:
            caption += f" These sources were silent all the time: {', '.join(silent)}."
        height = 54 * len(rows) + 68  # the rows and the time axis, px
        title = "Active source, and why others wait"
        return Figure("sources", title, caption, _keys(styles), height, traces, axes)

    def _bars(self, style: BandStyle, spans: list[tuple[int, Span]]) -> Trace:
        kind, colour = style.kind, style.colour
        # The border line keeps even a very short band visible.
        marker: dict[str, Any] = {"color": colour, "line": {"color": colour, "width": 1}}
        if style.pattern:
            marker["pattern"] = {"shape": style.pattern}
        return {
            "type": "bar",
            "orientation": "h",
            "name": label(style.meaning),
            "base": numbers(self._ms(span.begin) for _, span in spans),
            "x": numbers(1000 * (span.end - span.begin) for _, span in spans),
            "y": numbers(at for at, _ in spans),
            "width": 0.5,
            "marker": marker,
            "hovertext": [f"<b>{label(kind)}</b><br>{label(span.words)}" for _, span in spans],
            "hoverinfo": "text",
            "text": [label(kind) for _ in spans],
            "textposition": "inside",
            "insidetextanchor": "middle",
            "textangle": 0,
        }

    def events(self) -> Figure:
        """Return the picture of the events, with a row for each level."""
        levels, marks = ("info", "warning", "error"), self._data.marks
        traces = [
            self._marks(level, at, [mark for mark in marks.all() if mark.level == level])
            for at, level in enumerate(levels)
        ]
        axes = self._timed() | {
            "yaxis": {"range": [-0.5, len(levels)], "visible": False, "fixedrange": True},
            "annotations": [note(level, 0, at + 0.42) for at, level in enumerate(levels)],
        }
        caption = "Point at a mark to read its event. The list of events is at the end of the page."
        keys = [Key("◆", COLOURS[level], level) for level in reversed(levels)]
        return Figure("events", "Events", caption, keys, 230, traces, axes)

    def _marks(self, level: str, at: int, marks: list[Mark]) -> Trace:
        return scatter(
            level,
            [self._ms(mark.t) for mark in marks],
            [at for _ in marks],
            mode="markers",
            marker={"symbol": "diamond", "size": 11, "color": COLOURS[level]},
            hovertext=[sentence(mark) for mark in marks],
            hoverinfo="text",
        )

    # Shared parts.

    def _ms(self, t: float) -> float:
        return self._zero_ms + 1000 * t

    def _timed(self) -> dict[str, Any]:
        seconds = max(self._data.seconds, 0.1)
        axis = {
            "type": "date",
            "range": [self._ms(-0.01 * seconds), self._ms(1.01 * seconds)],
            # Otherwise plotly turns the labels of a narrow picture and cuts them at its lower edge.
            "tickangle": 0,
            # Invisible ticks keep the time labels away from the lowest label of the y axis.
            "ticks": "outside", "ticklen": 8, "tickcolor": "rgba(0,0,0,0)",
        }  # fmt: skip
        return layout() | {"xaxis": axis, "margin": {"l": 44, "r": 12, "t": 8, "b": 44}}

    def _stack(self, name: str, title: str, caption: str, parts: list[Part], px: int) -> Figure:
        # Diagrams of `px` px, one below the other.
        traces, notes = list[Trace](), list[dict[str, Any]]()
        axes = self._timed()
        axes["margin"] |= {"t": GAP_PX}
        # Each cell of plotly's grid contains one diagram. All diagrams share the x axis.
        names = ["", *map(str, range(2, len(parts) + 1))]
        axes["grid"] = {"subplots": [[f"xy{n}"] for n in names], "ygap": GAP_PX / px}
        for n, part in zip(names, parts, strict=True):
            axes[f"yaxis{n}"] = {"rangemode": "tozero"}
            notes.append(note(part.title, 0, 1) | {"yref": f"y{n} domain", "yanchor": "bottom"})
            traces += [self._line(line, f"y{n}") for line in part.lines]
            if part.beyond:
                traces.append(self._clips(part.lines[0], part.beyond, f"y{n}"))
        axes["annotations"] = notes
        lines = dict.fromkeys((line.name, line.colour) for part in parts for line in part.lines)
        keys = [Key("━", colour, meaning) for meaning, colour in lines]
        first = parts[0].lines[0]
        if any(part.beyond for part in parts):
            keys.append(Key("▲", first.colour, f"{first.name} outside of the picture"))
        return Figure(name, title, caption, keys, px * len(parts) + 70, traces, axes)

    def _line(self, line: Line, axis: str) -> Trace:
        return scatter(
            line.name,
            [self._ms(point.t) for point in line.points],
            [point.value for point in line.points],
            mode="lines",
            yaxis=axis,
            line={"color": line.colour, "width": line.width, "shape": line.shape},
            **_hover(line.name, line.values),
        )

    def _clips(self, line: Line, clips: Sequence[Clip], axis: str) -> Trace:
        symbols = ["triangle-up" if clip.value > clip.edge else "triangle-down" for clip in clips]
        return scatter(
            f"{line.name} outside",
            [self._ms(clip.t) for clip in clips],
            [clip.edge for clip in clips],
            mode="markers",
            yaxis=axis,
            marker={"symbol": symbols, "size": 11, "color": line.colour},
            **_hover(line.name, [clip.value for clip in clips]),
        )


def _hover(name: str, values: Sequence[float]) -> dict[str, Any]:
    field = "customdata" if values else "y"
    text = f"{name} %{{{field}:.3~f}}<br>%{{x|%H:%M:%S.%L}}<extra></extra>"
    return {"hovertemplate": text} | ({"customdata": numbers(values)} if values else {})
