"""Makes the report: one HTML file that needs no other file.

No text of unknown origin becomes code: each passes through `escaped`, and the pictures are JSON
without `<` in a block that browsers do not execute. As a second barrier, the content security
policy allows only the file's two scripts, by their hashes, and nothing to load.
"""

from __future__ import annotations

import binascii
import hashlib
import html
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

import msgspec

from acsard.core.formatting import lasting, printable
from acsard.core.values import NS_PER_S
from acsard.host.errors import RecordingError
from acsard.recording.file_replay import PROGRESS_STEPS, DisplayReplay, Progress, no_progress
from acsard.recording.mcap_file import Recording
from acsard.recording.replay_text import verdict
from acsard.recording.time_span import WHOLE_SPAN, Span, clock, date
from acsard.report.figures import TimeFigures
from acsard.report.plot_elements import Figure
from acsard.report.report_data import Mark, ReportData
from acsard.report.report_text import Clock, Origin, differences, notes, reasons, rows, summary

# The file of the npm package plotly.js-basic-dist-min 4.1.1, which draws curves and bars.
PLOTLY = Path(__file__).with_name("plotly-basic.min.js")

STYLE = """
:root { color-scheme: light dark; --ink: #1c2127; --soft: #59636e; --paper: #fff; --card: #f5f7f9;
  --rule: #dde2e7; --bad: #c22f2f; --warn: #9a5b00 }
@media (prefers-color-scheme: dark) { :root { --ink: #e6eaee; --soft: #a3adb8; --paper: #14181c;
  --card: #1d2328; --rule: #343c44; --bad: #ff8080; --warn: #ffb84d } }
@media print { :root { color-scheme: light; --ink: #000; --soft: #444; --paper: #fff; --card: #fff;
  --rule: #ccc; --bad: #a00; --warn: #7a4a00 } }
* { box-sizing: border-box }
body { margin: 0 auto; padding: 20px 24px 48px; max-width: 1180px; background: var(--paper);
  color: var(--ink); font: 16px/1.5 system-ui, sans-serif; overflow-wrap: anywhere }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 8px 0 }
h2 { font-size: 1.15rem; margin: 34px 0 2px }
p { margin: 4px 0 10px; max-width: 75ch }
.soft, figcaption { color: var(--soft); font-size: .9rem; max-width: 85ch }
.lead { font-size: 1.1rem }
.note { border-left: 4px solid var(--warn); padding: 4px 12px; background: var(--card) }
figure { margin: 0; break-inside: avoid }
.picture { width: 100% }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 4px 20px; padding: 12px 16px;
  background: var(--card); border: 1px solid var(--rule); border-radius: 8px; margin: 14px 0 }
dt { color: var(--soft) }
dd { margin: 0 }
table { border-collapse: collapse; width: 100%; font-size: .92rem }
th { text-align: left; color: var(--soft); font-weight: 500 }
th, td { padding: 5px 12px 5px 0; border-bottom: 1px solid var(--rule); vertical-align: top }
tr { break-inside: avoid }
.name { min-width: 11ch; overflow-wrap: normal }
summary { cursor: pointer; margin-top: 34px }
summary h2 { display: inline }
.time { white-space: nowrap; font-variant-numeric: tabular-nums }
.error { color: var(--bad); font-weight: 600 }
.warning { color: var(--warn); font-weight: 600 }
.keys { display: flex; flex-wrap: wrap; gap: 2px 18px; margin: 6px 0 0; font-size: .9rem;
  max-width: none }
.js-plotly-plot :is([class*="tick"] text, .annotation-text, .xtitle, .ytitle) {
  fill: var(--ink) !important }
.js-plotly-plot .gridlayer path { stroke: var(--rule) !important }
.js-plotly-plot .zerolinelayer path { stroke: var(--soft) !important }
@media (max-width: 600px) {
  body { padding: 12px 14px 40px }
  h1 { font-size: 1.3rem }
  dl { grid-template-columns: 1fr; gap: 0 }
  dd { margin-bottom: 8px }
  .rows thead { display: none }
  .rows tr { display: block; padding: 6px 0; border-bottom: 1px solid var(--rule) }
  .rows td { display: inline; border: 0; padding: 0 8px 0 0 }
  .rows td.name { font-weight: 600 }
  .settings td:last-child::before { content: "default " }
  .rows td:last-child { color: var(--soft) }
}
@media print { .modebar { display: none } }
body.paper { width: 180mm; padding: 0 }
@page { size: A4; margin: 14mm }
"""

PROGRAM = """
"use strict";
const boxes = [], timed = [];
const layoutOptions = { responsive: true, displaylogo: false, plotlyServerURL: "",
  modeBarButtons: [["zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]] };
const MAX_LABEL_PX = 90;  // includes the gap to the next label
const labels = box => ({ "xaxis.nticks": Math.max(2, Math.floor(box.clientWidth / MAX_LABEL_PX)) });
for (const one of JSON.parse(document.getElementById("pictures").textContent)) {
  const box = document.getElementById(one.name);
  // A finger that scrolls the page must not draw a frame in the picture.
  if (matchMedia("(pointer: coarse)").matches) one.layout.dragmode = false;
  Plotly.newPlot(box, one.data, one.layout, layoutOptions);
  boxes.push(box);
  if (one.timed) timed.push(box);
}
const fit = () => { for (const box of timed) Plotly.relayout(box, labels(box)); };
fit();
addEventListener("resize", fit);
let following = false;
for (const box of timed) box.on("plotly_relayout", async change => {
  const all = "xaxis.autorange" in change, [from, to] = box.layout.xaxis.range;
  if (following || !(all || "xaxis.range[0]" in change)) return;
  following = true;
  for (const other of timed) if (other !== box)
    await Plotly.relayout(other, { "xaxis.range": [from, to] });
  following = false;
});
const paper = on => {
  document.body.classList.toggle("paper", on);
  if (on) for (const one of document.querySelectorAll("details")) one.open = true;
  for (const box of boxes)  // all in one task, because the browser prints without waiting
    Plotly.relayout(box, on ? { width: box.clientWidth } : { width: null, autosize: true });
  fit();
};
addEventListener("beforeprint", () => paper(true));
addEventListener("afterprint", () => paper(false));
"""


MAX_UNFOLDED_EVENTS = 40  # unfolded when the page loads


def escaped(text: str) -> str:
    """Return text escaped for HTML; unprintable characters are U+FFFD."""
    return html.escape(printable(text))


def page(
    data: ReportData, origin: Origin, library: str, clock: Clock, offset_s: float = 0.0
) -> str:
    """Return the report as one HTML file; `library` is plotly, `offset_s` local time minus UTC."""
    figures = TimeFigures(data, offset_s).all()
    title = escaped(f"{origin.robot}, {clock(data.began or 0.0, True)}")
    body = [
        f"<h1>{title}</h1>",
        f'<p class="lead">{escaped(summary(data))}</p>',
        *[f'<p class="note">{escaped(note)}</p>' for note in notes(data, origin)],
        _rows(data, origin, clock),
        "<noscript><p class=note>The pictures need JavaScript.</p></noscript>",
        *[_figure(f) + (_reasons(data) if f.name == "sources" else "") for f in figures],
        _settings(data),
        _events(data, clock),
    ]
    encoded = msgspec.json.encode(
        [{"name": f.name, "data": f.data, "layout": f.layout, "timed": f.timed} for f in figures]
    )
    pictures = encoded.decode().replace("<", "\\u003c")
    policy = (
        f"default-src 'none'; script-src {_hash(library)} {_hash(PROGRAM)}; "
        "style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    return "\n".join(
        [
            '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{title}</title><style>{STYLE}</style></head><body>",
            *body,
            f'<script type="application/json" id="pictures">{pictures}</script>',
            f"<script>{library}</script>",
            f"<script>{PROGRAM}</script>",
            "</body></html>\n",
        ]
    )


def make_report(
    recording: Recording, span: Span = WHOLE_SPAN, progress: Progress = no_progress
) -> tuple[str, list[str]]:
    """Replay a part of a recording; return the HTML file and the report's notes.

    Raises `RecordingError`.
    """
    about, replayed = recording.about, DisplayReplay(recording)
    began = about.wall_ns / NS_PER_S
    data = ReportData(replayed.config, began + span.begin, began + span.end, replayed.state_errors)
    for number, (step, outputs, robot) in enumerate(replayed.steps()):
        if number % PROGRESS_STEPS == 0:
            progress(step.inputs.now.wall_ns)
        data.step(step, outputs, robot)
        if data.past_end:
            # Read the rest of the recording too, so that the notes count every damaged place.
            deque(recording.messages(), maxlen=0)
            break
    if data.began is None:
        raise RecordingError(
            f"{recording.path} has no step in that span of time, so there is nothing to draw: "
            "correct --from and --to"
        )
    data.end("" if data.past_end else recording.ending)
    remarks = [*filter(None, [recording.missing_text]), *replayed.notes]
    comparison = replayed.replay.comparison
    if not (comparison.same or replayed.notes or data.missing):
        what = "the texts of reasons or events" if comparison.only_words else "the results"
        remarks.append(
            f"when this version of acsard replays the recording, {what} differ from the recorded "
            f"ones: {verdict(comparison)}"
        )
    names = ", ".join(path.name for path in recording.paths)
    origin = Origin(names, about.robot, about.version, about.python, tuple(remarks))
    offset_s = time.localtime(data.began).tm_gmtoff
    library = PLOTLY.read_text(encoding="utf-8")
    return page(data, origin, library, clock, offset_s), notes(data, origin)


def _hash(program: str) -> str:
    digest = hashlib.sha256(program.encode()).digest()
    return f"'sha256-{binascii.b2a_base64(digest, newline=False).decode()}'"


def _rows(data: ReportData, origin: Origin, clock: Clock) -> str:
    pairs = rows(data, origin, clock)
    return f"<dl>{''.join(f'<dt>{escaped(k)}</dt><dd>{escaped(v)}</dd>' for k, v in pairs)}</dl>"


def _figure(figure: Figure) -> str:
    box = f'<div class="picture" id="{figure.name}" style="height:{figure.height}px"></div>'
    caption = f"<figcaption>{escaped(figure.caption)}</figcaption>"
    keys = "".join(
        f'<span><b style="color:{key.colour}">{key.sign}</b> {escaped(key.meaning)}</span>'
        for key in figure.keys
    )
    legend = f'<p class="keys">{keys}</p>'
    return f"<figure><h2>{escaped(figure.title)}</h2>{caption}{legend}{box}</figure>"


def _reasons(data: ReportData) -> str:
    cells = [
        (_cell(name, "name"), _cell(state, "time"), _cell(words), _cell(lasting(seconds), "time"))
        for name, state, words, seconds in reasons(data)
    ]
    return (
        _table(["source", "", "why the source did not drive", "duration"], cells) if cells else ""
    )


def _events(data: ReportData, clock: Clock) -> str:
    left_out, marks = data.marks.left_out, data.marks.all()
    # A recording may cross midnight, and the clock may be set during a recording.
    dated = len({date(mark.seconds) for mark in marks}) > 1

    def time_of(mark: Mark) -> str:
        at = clock(mark.seconds, False)
        return f"{date(mark.seconds)} {at}" if dated else at

    cells = [
        (
            _cell(time_of(mark), "time"),
            _cell(mark.name.replace("_", " "), f"name {mark.level}"),
            _cell(mark.text),
            _cell(mark.by),
        )
        for mark in marks
    ]
    more = (
        f'<p class="soft">{left_out} more events with these names are left out; '
        "acsard recording show prints all of them.</p>"
        if left_out
        else ""
    )
    table = _table(["time", "event", "what", "by"], cells)
    attribute = " open" if len(marks) <= MAX_UNFOLDED_EVENTS else ""
    heading = f"<summary><h2>All {len(marks)} events</h2></summary>"
    return f"<details{attribute}>{heading}{table}</details>{more}"


def _settings(data: ReportData) -> str:
    changed = differences(data.config)
    if not changed:
        return "<h2>Configuration</h2><p>Every key has its default.</p>"
    cells = [tuple(map(_cell, setting)) for setting in changed]
    heading = "<h2>Configuration keys that differ from the default</h2>"
    return heading + _table(["key", "here", "default"], cells, "rows settings")


def _cell(text: str, kind: str = "") -> str:
    attribute = f' class="{escaped(kind)}"' if kind else ""
    return f"<td{attribute}>{escaped(text)}</td>"


def _table(names: list[str], cells: Sequence[tuple[str, ...]], kind: str = "rows") -> str:
    head = "".join(f"<th>{name}</th>" for name in names)
    body = "".join(f"<tr>{''.join(row)}</tr>" for row in cells)
    return f'<table class="{kind}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
