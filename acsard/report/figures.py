"""The pictures of a course over time; `Pictures.all` returns every picture of a report.

Times are local times in ms since 1970, because the library knows no time zones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from acsard.core.thinning import Point, Span
from acsard.core.values import WHEELS
from acsard.report.command_sources import OTHERS
from acsard.report.course import Course, Mark
from acsard.report.drawing import (
    COLOURS,
    LIMITED,
    MEASURED,
    UNKNOWN,
    WISHED,
    Figure,
    Key,
    Trace,
    commander,
    label,
    layout,
    note,
    numbers,
    path,
    scatter,
    sentence,
)

ROW_PX, ROOM_PX = 54, 68
"""Height of a row of bands, and additional height for the time axis."""


class Line(NamedTuple):
    """A curve of a picture; `shape` is plotly's interpolation between two values."""

    name: str
    colour: str
    points: Sequence[Point]
    shape: str = "linear"
    width: float = 1.6
    """Line width, px."""


GAP_PX = 30
"""Height of the gap above each of several pictures, for its title."""

BENEATH = 3.4
"""Width of a curve that another one nearly covers, so that its colour shows on both sides."""


class Part(NamedTuple):
    """One of several pictures above a common time axis."""

    title: str
    lines: list[Line]


Row = tuple[str, list[Span]]
"""The name of a row and its bands."""

DRIVES = "drives"


class Look(NamedTuple):
    """Appearance of the bands of one kind. Each driving source has its own."""

    kind: str
    who: str
    """Name of the driving source; "" applies to all rows."""
    colour: str
    pattern: str = ""

    @property
    def told(self) -> str:
        return f"{self.who} {self.kind}".strip()

    def of(self, row: Row) -> list[Span]:
        """Return the bands of a row with this appearance."""
        name, spans = row
        return [one for one in spans if one.kind == self.kind] if self.who in ("", name) else []


def _looks(rows: list[Row]) -> Iterator[Look]:
    drivers = [name for name, spans in rows if any(one.kind == DRIVES for one in spans)]
    for kind in dict.fromkeys(span.kind for _, spans in rows for span in spans):
        if kind == DRIVES:
            for number, name in enumerate(drivers):
                yield Look(kind, name, *commander(number))
        else:
            yield Look(kind, "", COLOURS.get(kind, UNKNOWN))


def _keys(looks: list[Look]) -> list[Key]:
    """Return one legend entry for each colour and pattern, with all its meanings."""
    meanings: dict[tuple[str, str], list[str]] = {}
    for one in looks:
        meanings.setdefault((one.colour, one.pattern), []).append(one.told)
    return [
        Key("▨" if pattern else "■", colour, ", ".join(told))
        for (colour, pattern), told in meanings.items()
    ]


class Pictures:
    """Draws a course; `offset_s` is the local time's offset from UTC."""

    def __init__(self, course: Course, offset_s: float) -> None:
        self._course = course
        self._zero_ms = 1000 * ((course.began or 0.0) + offset_s)

    def all(self) -> list[Figure]:
        """Return all pictures in the order of the page."""
        return [
            path(self._course), self.speeds(), self.who(), self.events(), self.wheels(),
            self.link(), self.loop(),
        ]  # fmt: skip

    def speeds(self) -> Figure:
        course = self._course
        parts = [
            Part(
                title,
                [
                    Line("commanded", WISHED, curves["wished"].points(), "hv"),
                    Line("limited", LIMITED, curves["limited"].points(), "hv", BENEATH),
                    Line("measured", MEASURED, curves["measured"].points()),
                ],
            )
            for title, curves in (
                ("forward, m/s", course.linear),
                ("turning, rad/s", course.angular),
            )
        ]
        caption = (
            "Commanded is the speed of the source that drives; limited is the speed sent to the "
            "wheels; measured is the speed that they reported. Left turns and forward driving are "
            "above zero."
        )
        return self._stack("speeds", "Speed", caption, parts, 210)

    def wheels(self) -> Figure:
        pairs = zip(WHEELS, self._course.asked, self._course.turned, strict=True)
        parts = [
            Part(
                f"{name.replace('_', ' ')}, rad/s",
                [
                    Line("commanded", LIMITED, asked.points(), "hv", BENEATH),
                    Line("measured", MEASURED, turned.points()),
                ],
            )
            for name, asked, turned in pairs
        ]
        caption = "Above zero drives the robot forward."
        return self._stack("wheels", "The four wheels", caption, parts, 150)

    def link(self) -> Figure:
        link = self._course.link
        bad = [Line("dropped", COLOURS["error"], link.dropped.points(), "hvh")]
        if not self._course.config.mcu.reply_period:
            bad.append(Line("no answer", WISHED, link.unanswered.points(), "hvh"))
        parts = [
            Part(
                "lines per second",
                [
                    Line("sent", LIMITED, link.sent.points(), "hvh", BENEATH),
                    Line("answered", MEASURED, link.good.points(), "hvh"),
                ],
            ),
            Part("lost per second", bad),
        ]
        caption = (
            "Dropped lines arrived, but were unreadable or implausible. Lines without an answer "
            "were lost on the way there or back."
        )
        return self._stack("link", "The serial line", caption, parts, 170)

    def loop(self) -> Figure:
        late = Line("late", LIMITED, self._course.lateness.points(), "hv")
        caption = (
            "Delay from the time at which a period is due to its step, relative to the least delay."
        )
        return self._stack("loop", "The control loop", caption, [Part("late, ms", [late])], 200)

    def who(self) -> Figure:
        course, silent = self._course, list[str]()
        rows: list[Row] = [
            ("mode", course.modes.spans()),
            ("link", course.links.spans()),
        ]
        for name, band in course.sources.bands.items():
            if band.spans():
                rows.append((name, band.spans()))
            elif name != OTHERS:
                silent.append(name)
        looks = list(_looks(rows))
        data = [self._bars(look, [(at, s) for at, row in enumerate(rows) for s in look.of(row)])
                for look in looks]  # fmt: skip
        axes = self._timed() | {
            "barmode": "overlay",
            "uniformtext": {"mode": "hide", "minsize": 11},
            "yaxis": {"range": [len(rows) - 0.45, -0.75], "visible": False, "fixedrange": True},
            "annotations": [note(name, 0, at - 0.44) for at, (name, _) in enumerate(rows)],
        }
        caption = (
            "Point at a band to read the reason. A source waits while a source before it sends."
        )
        if silent:
            caption += f" Silent all the time: {', '.join(silent)}."
        height = ROW_PX * len(rows) + ROOM_PX
        return Figure(
            "who", "Active source, and why others wait", caption, _keys(looks), height, data, axes
        )

    def _bars(self, look: Look, spans: list[tuple[int, Span]]) -> Trace:
        kind, colour = look.kind, look.colour
        # The border line keeps even a very short band visible.
        marker: dict[str, Any] = {"color": colour, "line": {"color": colour, "width": 1}}
        if look.pattern:
            marker["pattern"] = {"shape": look.pattern}
        return {
            "type": "bar",
            "orientation": "h",
            "name": label(look.told),
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
        levels, kept = ("info", "warning", "error"), self._course.marks
        data = [
            self._marks(level, at, [mark for mark in kept.all() if mark.level == level])
            for at, level in enumerate(levels)
        ]
        axes = self._timed() | {
            "yaxis": {"range": [-0.5, len(levels)], "visible": False, "fixedrange": True},
            "annotations": [note(level, 0, at + 0.42) for at, level in enumerate(levels)],
        }
        caption = "Point at a mark to read it; the full list is at the end."
        keys = [Key("◆", COLOURS[level], level) for level in reversed(levels)]
        return Figure("events", "Events", caption, keys, 230, data, axes)

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
        seconds = max(self._course.seconds, 0.1)
        axis = {
            "type": "date",
            "range": [self._ms(-0.01 * seconds), self._ms(1.01 * seconds)],
            # Invisible ticks keep the time labels away from the lowest label of the y axis.
            "ticks": "outside", "ticklen": 8, "tickcolor": "rgba(0,0,0,0)",
        }  # fmt: skip
        return layout() | {"xaxis": axis, "margin": {"l": 44, "r": 12, "t": 8, "b": 44}}

    def _stack(self, name: str, title: str, caption: str, parts: list[Part], px: int) -> Figure:
        """Draw pictures above each other, with one time axis and one legend."""
        data, notes = list[Trace](), list[dict[str, Any]]()
        axes = self._timed()
        axes["margin"] |= {"t": GAP_PX}
        # Each cell of the grid is a picture. The x axis belongs to all of them.
        names = ["", *map(str, range(2, len(parts) + 1))]
        axes["grid"] = {"subplots": [[f"xy{n}"] for n in names], "ygap": GAP_PX / px}
        for n, part in zip(names, parts, strict=True):
            axes[f"yaxis{n}"] = {"rangemode": "tozero"}
            notes.append(note(part.title, 0, 1) | {"yref": f"y{n} domain", "yanchor": "bottom"})
            data += [self._line(line, f"y{n}") for line in part.lines]
        axes["annotations"] = notes
        lines = dict.fromkeys((line.name, line.colour) for part in parts for line in part.lines)
        keys = [Key("━", colour, meaning) for meaning, colour in lines]
        return Figure(name, title, caption, keys, px * len(parts) + 70, data, axes)

    def _line(self, line: Line, axis: str) -> Trace:
        return scatter(
            line.name,
            [self._ms(point.t) for point in line.points],
            [point.value for point in line.points],
            mode="lines",
            yaxis=axis,
            line={"color": line.colour, "width": line.width, "shape": line.shape},
            hovertemplate=f"{line.name} %{{y:.3~f}}<br>%{{x|%H:%M:%S.%L}}<extra></extra>",
        )
