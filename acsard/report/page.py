"""A report as one self-contained HTML file, in which no text of unknown origin can become code.

Texts pass `escaped`. The pictures are JSON in a block that browsers do not execute, without any
`<`. As a second barrier, the page's security policy allows only its two scripts, by their hashes,
and forbids all loading.
"""

from __future__ import annotations

import binascii
import hashlib
import html
from collections.abc import Sequence

import msgspec

from acsard.formatting import lasting, printable
from acsard.report.account import Clock, Origin, differences, notes, reasons, rows, summary
from acsard.report.course import Course
from acsard.report.drawing import Figure
from acsard.report.figures import Pictures
from acsard.report.look import PROGRAM, STYLE

MOST_OPEN = 40
"""Number of events up to which the list is open at first."""


def escaped(text: str) -> str:
    """Return any text as safe HTML."""
    return html.escape(printable(text))


def page(course: Course, origin: Origin, library: str, clock: Clock, offset_s: float = 0.0) -> str:
    """Return the text of the file.

    `library` is the code of plotly, `offset_s` the local time's offset from UTC.
    """
    figures = Pictures(course, offset_s).all()
    title = escaped(f"{origin.robot}, {clock(course.began or 0.0, True)}")
    body = [
        f"<h1>{title}</h1>",
        f'<p class="lead">{escaped(summary(course))}</p>',
        *[f'<p class="note">{escaped(note)}</p>' for note in notes(course, origin)],
        _rows(course, origin, clock),
        "<noscript><p class=note>The pictures need JavaScript.</p></noscript>",
        *[_figure(one) + (_reasons(course) if one.name == "who" else "") for one in figures],
        _settings(course),
        _events(course, clock),
    ]
    data = msgspec.json.encode(
        [{"name": f.name, "data": f.data, "layout": f.layout, "timed": f.timed} for f in figures]
    )
    inside = data.decode().replace("<", "\\u003c")
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
            f'<script type="application/json" id="pictures">{inside}</script>',
            f"<script>{library}</script>",
            f"<script>{PROGRAM}</script>",
            "</body></html>\n",
        ]
    )


def _hash(program: str) -> str:
    digest = hashlib.sha256(program.encode()).digest()
    return f"'sha256-{binascii.b2a_base64(digest, newline=False).decode()}'"


def _rows(course: Course, origin: Origin, clock: Clock) -> str:
    told = rows(course, origin, clock)
    return f"<dl>{''.join(f'<dt>{escaped(k)}</dt><dd>{escaped(v)}</dd>' for k, v in told)}</dl>"


def _figure(figure: Figure) -> str:
    box = f'<div class="picture" id="{figure.name}" style="height:{figure.height}px"></div>'
    caption = f"<figcaption>{escaped(figure.caption)}</figcaption>"
    keys = "".join(
        f'<span><b style="color:{key.colour}">{key.sign}</b> {escaped(key.meaning)}</span>'
        for key in figure.keys
    )
    legend = f'<p class="keys">{keys}</p>'
    return f"<figure><h2>{escaped(figure.title)}</h2>{caption}{legend}{box}</figure>"


def _reasons(course: Course) -> str:
    cells = [
        (
            f'<td class="name">{escaped(name)}</td>',
            f'<td class="time">{escaped(does)}</td>',
            f"<td>{escaped(words)}</td>",
            f'<td class="time">{lasting(seconds)}</td>',
        )
        for name, does, words, seconds in reasons(course)
    ]
    return _table(["source", "", "why it did not drive", "for"], cells) if cells else ""


def _events(course: Course, clock: Clock) -> str:
    began, left_out, marks = course.began or 0.0, course.marks.left_out, course.marks.all()
    cells = [
        (
            f'<td class="time">{escaped(clock(began + mark.t, False))}</td>',
            f'<td class="name {escaped(mark.level)}">{escaped(mark.name.replace("_", " "))}</td>',
            f"<td>{escaped(mark.text)}</td>",
            f"<td>{escaped(mark.by)}</td>",
        )
        for mark in marks
    ]
    more = (
        f'<p class="soft">{left_out} more of the same names are left out; acsard log show tells '
        "all.</p>"
        if left_out
        else ""
    )
    table = _table(["time", "event", "what", "by"], cells)
    shown = " open" if len(marks) <= MOST_OPEN else ""
    heading = f"<summary><h2>All {len(marks)} events</h2></summary>"
    return f"<details{shown}>{heading}{table}</details>{more}"


def _settings(course: Course) -> str:
    changed = differences(course.config)
    if not changed:
        return "<h2>Configuration</h2><p>As by default, every key.</p>"
    cells = [tuple(f"<td>{escaped(part)}</td>" for part in setting) for setting in changed]
    heading = "<h2>Configuration, where it is not the default</h2>"
    return heading + _table(["key", "here", "default"], cells, "rows settings")


def _table(names: list[str], cells: Sequence[tuple[str, ...]], kind: str = "rows") -> str:
    head = "".join(f"<th>{name}</th>" for name in names)
    body = "".join(f"<tr>{''.join(row)}</tr>" for row in cells)
    return f'<table class="{kind}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
