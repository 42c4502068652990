"""Draws the messages of an export as one HTML file: the path, and diagrams over one time axis.

No recorded text becomes code: each passes through `escaped`, the diagrams are JSON without `<` in a
block that browsers do not execute, and the content security policy allows only the file's two
scripts, by their hashes, and nothing to load.
"""

from __future__ import annotations

import hashlib
import html
import math
import operator
import textwrap
import time
from binascii import b2a_base64
from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct

from acsard.core.formatting import lasting, many, printable
from acsard.core.messages.schema import JointState, Odometry, RobotState, TwistStamped
from acsard.core.ros.shapes import LEVELS, Log
from acsard.core.values import NS_PER_S, WHEELS, wheel_names, wheels4
from acsard.recording.published import Published

# The file of the npm package plotly.js-basic-dist-min 4.1.1, which draws curves and bars.
PLOTLY = Path(__file__).with_name("plotly-basic.min.js")

KEYS = frozenset({"odom", "wheel_states", "cmd_vel_out", "state"})  # what a report draws

MAX_ROWS = 4000  # of a curve: several times the width of a screen in pixels
MAX_EVENTS = 2000  # the newest ones

# A curve has a gap after a second without a message; if it is thinned, after as many seconds as
# messages for each row.
GAP_S = 1.0

JUMP_M = 1.0  # no robot drives so far between two messages: its pose was set

# Plotly's own, so that a curve has one colour in both diagrams of the speeds.
PALETTE = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b")
BAD, WARN, GOOD, REST, WAIT, NEUTRAL = (
    "#d43d3d", "#e08600", "#159a6b", "#8fb8de", "#a98fd0", "#9a9a9a"
)  # fmt: skip
COLOURS = {
    "driving": GOOD, "ready": REST, "waiting": WAIT, "stopped": WARN, "fault": BAD,
    "up": REST, "booting": WAIT, "stale": WARN, "down": BAD, "drives": GOOD, "waits": WAIT,
    "debug": NEUTRAL, "info": REST, "warning": WARN, "error": BAD,
}  # fmt: skip

LEVEL_NAMES = {number: name for name, number in LEVELS.items()}

STYLE = """
:root { color-scheme: light dark; --ink: #1c2127; --soft: #59636e; --paper: #fff; --rule: #dde2e7 }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6eaee; --soft: #a3adb8; --paper: #14181c; --rule: #343c44 } }
* { box-sizing: border-box }
body { margin: 0 auto; padding: 16px; max-width: 1180px; background: var(--paper);
  color: var(--ink); font: 16px/1.5 system-ui, sans-serif; overflow-wrap: anywhere }
.note { border-left: 4px solid #e08600; padding: 4px 12px }
th { text-align: left; color: var(--soft); font-weight: 500; min-width: 6ch }
td:nth-child(2) { overflow-wrap: normal }
th, td { padding: 4px 12px 4px 0; border-bottom: 1px solid var(--rule); vertical-align: top }
.error, .warning { font-weight: 600 }
.js-plotly-plot :is(text) { fill: var(--ink) !important }
.js-plotly-plot .hoverlayer text { fill: #fff !important }
.js-plotly-plot .gridlayer path { stroke: var(--rule) !important }
"""

PROGRAM = """
"use strict";
for (const one of JSON.parse(document.getElementById("pictures").textContent)) {
  // A finger that scrolls the page must not draw a frame in the picture.
  if (matchMedia("(pointer: coarse)").matches) one.layout.dragmode = false;
  Plotly.newPlot(one.name, one.data, one.layout, { responsive: true, displaylogo: false });
}
"""

COUNTED_S = 1.0  # between two rows of the counters

Row = tuple[float, ...]  # s since 1970, and the values of the curves

Trace = dict[str, Any]  # curves, marks or bars, as plotly describes them

HEIGHT_PX, GAP = 200, 0.3  # of each diagram over time, and the part of it that its legend has


class Figure(Struct, frozen=True):
    name: str
    data: list[Trace]
    layout: dict[str, Any]


class Diagram(NamedTuple):
    title: str  # of its y axis
    traces: list[Trace]
    axis: dict[str, Any]


class Rows:
    """Rows over time. If there are too many, every second one goes, again and again."""

    def __init__(self, gap_s: float = GAP_S) -> None:
        self._gap_s = gap_s
        self._kept: list[Row] = []
        self._stride = 1  # messages for each row
        self._count = 0
        self.last: Row | None = None

    def add(self, *row: float) -> None:
        self.last = row
        if self._count % self._stride == 0:
            self._kept.append(row)
            if len(self._kept) > MAX_ROWS:
                del self._kept[1::2]
                self._stride *= 2
        self._count += 1

    def rows(self) -> Iterator[Row]:
        """Yield the rows to draw; one of NaN is a gap."""
        rows = [*self._kept]
        if self.last is not None and self.last is not rows[-1]:
            rows.append(self.last)
        for before, row in pairwise(rows):
            yield before
            if row[0] - before[0] > self._gap_s * self._stride:
                yield (before[0], *[math.nan] * (len(before) - 1))
        yield from rows[-1:]


class Span(Struct):
    """A time, s since 1970, in which a row of the bands has one state."""

    begin: float
    end: float
    kind: str
    code: str
    text: str


class Drawing:
    """What a report draws of messages."""

    def __init__(self, messages: Iterable[Published]) -> None:
        self.path, self.wheels, self.counters = Rows(), Rows(), Rows(3 * COUNTED_S)
        self.wheel_names: tuple[str, ...] = WHEELS  # of the last message
        self.speeds: dict[str, Rows] = defaultdict(Rows)  # m/s and rad/s, by the name of the curve
        self.bands: dict[str, list[Span]] = defaultdict(list)
        self.events: deque[tuple[float, Log, Row | None]] = deque(maxlen=MAX_EVENTS)
        self.counts: Counter[tuple[int, str]] = Counter()  # events by level and name
        self.begin = self.end = 0.0  # s since 1970
        self.metres = self.driving_s = self.fastest = 0.0
        self._counted: tuple[float, Row] = (0.0, ())
        for message in messages:
            self._add(message)

    def _add(self, item: Published) -> None:
        t, message = item.wall_ns / NS_PER_S, item.message
        self.begin, self.end = self.begin or t, t
        match message:
            case Odometry():
                self._odometry(t, message)
            case JointState(velocity=[_, _, *_] as velocity):
                self.wheels.add(t, *wheels4(velocity))
                self.wheel_names = wheel_names(len(velocity))
            case TwistStamped(twist=twist):
                name = f"commanded by {item.source}" if item.source else "limited"
                self.speeds[name].add(t, twist.linear.x, twist.angular.z)
            case RobotState():
                self._state(t, message)
            case Log():
                self.events.append((t, message, self.path.last))
                self.counts[message.level, message.name] += 1

    def _odometry(self, t: float, message: Odometry) -> None:
        place, twist = message.pose.pose.position, message.twist.twist
        last = self.path.last
        step = math.hypot(place.x - last[1], place.y - last[2]) if last else 0.0
        if step < JUMP_M:
            self.metres += step
        self.fastest = max(self.fastest, abs(twist.linear.x))
        self.path.add(t, place.x, place.y)
        self.speeds["measured"].add(t, twist.linear.x, twist.angular.z)

    def _state(self, t: float, state: RobotState) -> None:
        for name, kind, code, text in _bands(state):
            spans = self.bands[name]
            if spans and t - spans[-1].end < GAP_S:
                if name == "mode" and spans[-1].kind == "driving":
                    self.driving_s += max(0.0, t - spans[-1].end)
                spans[-1].end = t
                if (spans[-1].kind, spans[-1].code) == (kind, code):
                    continue
            spans.append(Span(t, t, kind, code, text))
        then, before = self._counted
        if not 0 <= t - then < COUNTED_S:
            self._counted = t, counts = t, _counts(state.counters)
            # The counters of another run of the daemon begin at 0.
            if before and t > then and all(map(operator.le, before, counts)):
                self.counters.add(
                    t, *[(b - a) / (t - then) for a, b in zip(before, counts, strict=True)]
                )


COUNTERS = ("lines sent", "lines received", "lines dropped", "missed periods")


def _counts(counters: Mapping[str, int]) -> Row:
    dropped = sum(count for name, count in counters.items() if name.startswith("line_"))
    good = counters.get("lines", 0) - counters.get("line_implausible", 0)
    return counters.get("lines_sent", 0), good, dropped, counters.get("missed_periods", 0)


def _bands(state: RobotState) -> Iterator[tuple[str, str, str, str]]:
    yield "mode", state.mode, state.code, state.reason
    yield "link", state.link, "", ""
    for source in state.sources:
        drives = state.mode == "driving" and source.name == state.source
        waits = source.wait not in ("nothing", "command")
        kind = "drives" if drives else "waits" if waits else ""
        yield source.name, kind, source.wait, source.waits_for


def page(drawing: Drawing, title: str, notes: Sequence[str]) -> str:
    """Return the HTML file; `title` names the robot, and the notes what is missing."""
    figures = [_path(drawing), _diagrams(drawing)]
    pictures = msgspec.json.encode(figures).decode().replace("<", "\\u003c")
    library = PLOTLY.read_text(encoding="utf-8")
    policy = (
        f"default-src 'none'; script-src {_hash(library)} {_hash(PROGRAM)}; "
        "style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    title = escaped(f"{title}, {_clock(drawing.begin, '%Y-%m-%d %H:%M:%S')}")
    boxes = [
        f'<div id="{figure.name}" style="height:{figure.layout["height"]}px"></div>'
        for figure in figures
    ]
    return "\n".join(
        [
            '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{title}</title><style>{STYLE}</style></head><body><h1>{title}</h1>",
            f"<p>{escaped(_summary(drawing))}</p>",
            *[f'<p class="note">{escaped(note)}</p>' for note in notes],
            "<noscript><p class=note>The pictures need JavaScript.</p></noscript>",
            *boxes,
            _event_table(drawing),
            f'<script type="application/json" id="pictures">{pictures}</script>',
            f"<script>{library}</script><script>{PROGRAM}</script></body></html>\n",
        ]
    )


def escaped(text: str) -> str:
    """Return text for HTML and for plotly; unprintable characters are U+FFFD."""
    return html.escape(printable(text))


def _hover(head: str, text: str) -> str:
    # Not wider than a phone.
    lines = textwrap.wrap(printable(text), 42)
    return "<br>".join([f"<b>{escaped(head)}</b>", *map(escaped, lines)])


def _hash(program: str) -> str:
    digest = hashlib.sha256(program.encode()).digest()
    return f"'sha256-{b2a_base64(digest, newline=False).decode()}'"


def _clock(seconds: float, form: str) -> str:
    return time.strftime(form, time.localtime(seconds))


def _summary(drawing: Drawing) -> str:
    seconds = drawing.end - drawing.begin
    drove = (
        f"drove {drawing.metres:.2f} m in {lasting(drawing.driving_s)} of {lasting(seconds)}, "
        f"at most {drawing.fastest:.2f} m/s"
        if drawing.driving_s
        else f"did not drive in the recorded {lasting(seconds)}"
    )
    worst = sorted(drawing.counts.items(), key=lambda item: -item[0][0])
    events = [
        f"{name.replace('_', ' ')} ({count})"
        for (level, name), count in worst
        if level > LEVELS["info"] or name == "stop"
    ]
    return f"The robot {drove}. " + (f"Events: {', '.join(events)}." if events else "")


def _event_table(drawing: Drawing) -> str:
    dated = _clock(drawing.begin, "%x") != _clock(drawing.end, "%x")
    form = "%Y-%m-%d %H:%M:%S" if dated else "%H:%M:%S"
    rows = [
        f"<tr><td>{_clock(t, form)}.{int(t % 1 * 1000):03}"
        f'<td class="{LEVEL_NAMES[log.level]}">{escaped(log.name.replace("_", " "))}'
        f"<td>{escaped(log.msg)}"
        for t, log, _ in drawing.events
    ]
    left_out = drawing.counts.total() - len(rows)
    more = f", without the {many(left_out, 'earlier one')}" if left_out else ""
    head = "<tr><th>time<th>event<th>what"
    return f"<h2>{many(len(rows), 'event')}{more}</h2><table>{head}{''.join(rows)}</table>"


# Above its diagram, where no axis and no curve is.
LEGEND = {"orientation": "h", "y": 1, "yanchor": "bottom", "x": 0}


def _layout(height: int, **more: object) -> dict[str, Any]:
    clear = "rgba(0,0,0,0)"
    return {
        "height": height, "autosize": True, "paper_bgcolor": clear, "plot_bgcolor": clear,
        "margin": {"l": 60, "r": 12, "t": 30, "b": 40}, "legend": LEGEND,
        "modebar": {"bgcolor": clear}, **more,
    }  # fmt: skip


def _curve(name: str, x: Iterable[float], y: Iterable[float], **more: object) -> Trace:
    points = {"x": [*map(_number, x)], "y": [*map(_number, y)]}
    return {"type": "scatter", "mode": "lines", "name": escaped(name), **points, **more}


def _number(value: float) -> float | None:
    return round(value, 5) if math.isfinite(value) else None


def _ms(seconds: float) -> float:
    # Local time as UTC, because plotly does not know time zones.
    return 1000 * (seconds + time.localtime(seconds).tm_gmtoff)


def _marks(level: str, events: Sequence[Log], x: Iterable[float], y: Iterable[object]) -> Trace:
    return {
        "type": "scatter", "mode": "markers", "name": level, "x": [*x], "y": [*y],
        "marker": {"symbol": "diamond", "size": 10, "color": COLOURS[level]},
        "hovertext": [_hover(event.name.replace("_", " "), event.msg) for event in events],
        "hoverinfo": "text",
    }  # fmt: skip


def _path(drawing: Drawing) -> Figure:
    rows = list(drawing.path.rows())
    data = [_curve("path", *_columns(rows)[1:])]
    # The start is a ring, so that the end of a round does not hide it.
    for name, row, marker in (
        ("start", rows[:1], {"size": 20, "symbol": "circle-open", "color": NEUTRAL}),
        ("end", rows[-1:], {"size": 14, "color": GOOD}),
    ):
        data.append(_curve(name, *_columns(row)[1:], mode="markers", marker=marker))
    for level in ("warning", "error"):
        placed = [(log, at) for _, log, at in drawing.events if at and log.level == LEVELS[level]]
        if placed:
            x, y = [[at[axis] for _, at in placed] for axis in (1, 2)]
            data.append(_marks(level, [log for log, _ in placed], x, y))
    axes = {
        "xaxis": {"title": {"text": "x, m"}},
        "yaxis": {"title": {"text": "y, m"}, "scaleanchor": "x"},
    }
    return Figure("path", data, _layout(480, **axes))


def _columns(rows: Iterable[Row]) -> list[tuple[float, ...]]:
    return [*zip(*rows, strict=True)] or [(), (), ()]


def _diagrams(drawing: Drawing) -> Figure:
    bands = {name: spans for name, spans in drawing.bands.items() if any(s.kind for s in spans)}
    return _stacked(
        [
            Diagram("forward, m/s", _speeds(drawing, 1), _range(drawing, 1)),
            Diagram("turning, rad/s", _speeds(drawing, 2), _range(drawing, 2)),
            Diagram("wheels, rad/s", _over_time(drawing.wheels, drawing.wheel_names), {}),
            Diagram("per second", _over_time(drawing.counters, COUNTERS), {}),
            Diagram("", _bars(bands), _categories(bands)),
            Diagram("", _events(drawing), _categories(LEVELS)),
        ]
    )


def _over_time(rows: Rows, names: Sequence[str]) -> list[Trace]:
    times, *columns = _columns(rows.rows())
    x = [*map(_ms, times)]
    pairs = zip(names, columns, strict=False)
    return [_curve(name.replace("_", " "), x, column) for name, column in pairs]


def _speeds(drawing: Drawing, axis: int) -> list[Trace]:
    traces = []
    for number, (name, rows) in enumerate(sorted(drawing.speeds.items())):
        times, *columns = _columns(rows.rows())
        # A commanded speed lasts until the next one.
        shape = "linear" if name == "measured" else "hv"
        line = {"shape": shape, "color": PALETTE[number % len(PALETTE)]}
        traces.append(_curve(name, map(_ms, times), columns[axis - 1], line=line))
    return traces


def _bars(bands: Mapping[str, list[Span]]) -> list[Trace]:
    kinds: dict[str, list[tuple[str, Span]]] = defaultdict(list)
    for name, spans in bands.items():
        for span in spans:
            kinds[span.kind].append((escaped(name), span))
    kinds.pop("", None)
    return [
        {
            "type": "bar", "orientation": "h", "name": escaped(kind), "width": 0.7,
            # A legend of all kinds would need more rows than a phone has room for.
            "showlegend": False, "text": escaped(kind), "textposition": "inside", "textangle": 0,
            "y": [name for name, _ in rows],
            "base": [_ms(span.begin) for _, span in rows],
            "x": [1000 * (span.end - span.begin) for _, span in rows],
            # The border keeps a short span visible.
            "marker": {"color": colour, "line": {"color": colour, "width": 1}},
            "hovertext": [_hover(kind, span.text) for _, span in rows], "hoverinfo": "text",
        }
        for kind, rows in kinds.items()
        for colour in [COLOURS.get(kind, NEUTRAL)]
    ]  # fmt: skip


def _events(drawing: Drawing) -> list[Trace]:
    traces = []
    for level, number in LEVELS.items():
        events = [(t, log) for t, log, _ in drawing.events if log.level == number]
        x, y = [_ms(t) for t, _ in events], [level] * len(events)
        traces.append(_marks(level, [log for _, log in events], x, y))
    return traces


def _range(drawing: Drawing, axis: int) -> dict[str, Any]:
    # A command of 99 m/s must not flatten the other curves.
    values = [
        row[axis]
        for name in ("limited", "measured")
        for row in drawing.speeds[name].rows()
        if math.isfinite(row[axis])
    ]
    low, high = min(values, default=0.0), max(values, default=0.0)
    room = max(0.5 * (high - low), 0.1)
    return {"range": [low - room, high + room]}


def _categories(names: Iterable[str]) -> dict[str, Any]:
    names = [*map(escaped, names)]
    return {"type": "category", "categoryarray": names, "range": [len(names) - 0.5, -0.5]}


def _stacked(diagrams: Sequence[Diagram]) -> Figure:
    # Each diagram has its own y axis and legend, and all share the x axis.
    count, data = len(diagrams), list[Trace]()
    grid = {"rows": count, "columns": 1, "pattern": "coupled", "ygap": GAP}
    layout = _layout(count * HEIGHT_PX, barmode="overlay", grid=grid, xaxis={"type": "date"})
    for n, diagram in enumerate(diagrams, 1):
        number, top = "" if n == 1 else n, 1 - (n - 1) / (count - GAP)
        layout[f"yaxis{number}"] = {
            "title": {"text": diagram.title}, "automargin": True,
        } | diagram.axis  # fmt: skip
        layout[f"legend{number}"] = LEGEND | {"y": top}
        data += [
            {"showlegend": True, "yaxis": f"y{number}", "legend": f"legend{number}"} | trace
            for trace in diagram.traces
            if trace["x"]
        ]
    return Figure("time", data, layout)
