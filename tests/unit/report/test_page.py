"""The report is one HTML file that loads nothing, and no recorded text becomes markup in it."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from functools import lru_cache
from html.parser import HTMLParser

import pytest

from acsard.core.values import Command, Event, Refusal, Twist
from acsard.recording.recorded_steps import RecordedStep
from acsard.recording.time_span import date
from acsard.report.page import MAX_UNFOLDED_EVENTS, escaped, page
from acsard.report.report_data import Mark, ReportData
from acsard.report.report_text import Origin
from tests.unit.report.driven import drive_of_two, report_from

EVIL = '</script><script>alert(1)</script><img src=x onerror="alert(2)">\'"&lt;\u202e\x00<!--'

LIBRARY = "var Plotly = {};"


class PageElements(HTMLParser):
    """The elements of a page that a browser would see."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append((dict(attrs), ""))

    def handle_data(self, data: str) -> None:
        if self.lasttag == "script" and data.strip():
            attrs, before = self.scripts[-1]
            self.scripts[-1] = attrs, before + data
        elif data.strip():
            self.words.append(data)


def clock(seconds: float, day: bool) -> str:
    return f"{seconds:.1f}"


def origin(**others: str) -> Origin:
    known = {"file": "a.mcap", "robot": "r", "version": "1", "python": "3"} | others
    return Origin(known["file"], known["robot"], known["version"], known["python"])


def evil_steps() -> list[RecordedStep]:
    """Return a drive in which all text of unknown origin is hostile."""
    from msgspec.structs import replace

    _, steps = drive_of_two()
    new_steps = []
    for n, step in enumerate(steps[:300]):
        inputs, record = step.inputs, step.recorded
        if n == 150:
            now_ns = inputs.now.mono_ns
            command = Command(EVIL, Twist(), now_ns, sender=EVIL)
            refusal = Refusal("malformed", f"cmd/nav: {EVIL}", "nav", EVIL, now_ns)
            inputs = replace(inputs, commands=(command,), refusals=(refusal,))
            event = Event("stop", EVIL, by=EVIL)
            record = replace(record, events=(event,), status=(EVIL,) * 5)
        new_steps.append(replace(step, inputs=inputs, recorded=record))
    return new_steps


@lru_cache
def evil() -> str:
    return page(
        report_from(evil_steps()), origin(file=EVIL, robot=EVIL, version=EVIL), LIBRARY, clock
    )


def test_text_of_a_client_never_becomes_markup_or_code() -> None:
    read = PageElements(evil())
    assert not {"img", "iframe", "object", "a", "link"} & {tag for tag, _ in read.tags}
    assert all(not name.startswith("on") for _, attrs in read.tags for name in attrs)
    assert [bool(text) for _, text in read.scripts] == [True, True, True]
    assert "<script>alert" not in evil()
    assert evil().count("</script") == 3
    assert "\u202e" not in evil()
    assert "\x00" not in evil()
    # A person can still read the hostile text and its sender.
    assert sum("<script>alert(1)</script>" in words for words in read.words) >= 4


def test_texts_in_the_pictures_contain_no_markup_of_plotly() -> None:
    (pictures,) = [
        text for attrs, text in PageElements(evil()).scripts if attrs.get("id") == "pictures"
    ]
    assert "<" not in pictures
    traces = [trace for figure in json.loads(pictures) for trace in figure["data"]]
    texts = [text for t in traces for key in ("hovertext", "text") for text in t.get(key, ())]
    texts += [trace["name"] for trace in traces]
    alerts = [text for text in texts if "alert(1)" in text]
    assert len(alerts) >= 3  # the event, the mode, the refusal
    tags = {tag for text in texts for tag in re.findall(r"<[^>]*>", text)}
    assert tags <= {"<b>", "</b>", "<br>"}


def test_the_page_loads_nothing_and_runs_only_its_own_scripts() -> None:
    report, _ = drive_of_two()
    text = page(report, origin(), LIBRARY, clock)
    assert re.findall(r"(?:https?:)?//[\w.]+\.\w+", text) == []
    read = PageElements(text)
    assert all(not {"src", "href"} & set(attrs) for _, attrs in read.tags)
    (policy,) = [
        attrs["content"] for tag, attrs in read.tags if attrs.get("http-equiv") is not None
    ]
    assert policy is not None
    assert policy.startswith("default-src 'none'; ")
    programs = [body for attrs, body in read.scripts if "type" not in attrs]
    assert programs[0] == LIBRARY
    for program in programs:
        digest = base64.b64encode(hashlib.sha256(program.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy


def test_every_event_has_a_row_with_the_client_that_caused_it() -> None:
    report, _ = drive_of_two()
    words = PageElements(page(report, origin(), LIBRARY, clock)).words
    marks = report.marks.all()
    assert f"All {len(marks)} events" in words
    for mark in marks:
        assert escaped_words(mark) in words
    assert "unnamed (native)" in words


@pytest.mark.parametrize("apart_s", [3600, 86_400])
def test_the_events_of_several_days_have_a_date(apart_s: int) -> None:
    from acsard.core.config.settings import Config

    noon, report = 1_800_014_400.0, ReportData(Config())
    for seconds in (noon, noon + apart_s):
        report.marks.add(Mark(0.0, "stop", "stopped", "info", "", 1, None, seconds))
    times = PageElements(page(report, origin(), LIBRARY, clock)).words
    at = f"{noon:.1f}"
    assert (at if apart_s == 3600 else f"{date(noon)} {at}") in times


def escaped_words(mark: Mark) -> str:
    return mark.text or mark.name.replace("_", " ")


def test_missing_steps_are_reported_at_the_top() -> None:
    _, steps = drive_of_two()
    report = report_from(steps[:200] + steps[260:])
    notes = Origin(
        "a", "r", "1", "3", ("the file has no end: it was cut off, or is still being recorded",)
    )
    words = PageElements(page(report, notes, LIBRARY, clock)).words
    assert "the file has no end: it was cut off, or is still being recorded" in words
    assert any(text.startswith("60 steps are missing: ") for text in words)


@pytest.mark.parametrize(
    ("count", "opened"), [(MAX_UNFOLDED_EVENTS, True), (MAX_UNFOLDED_EVENTS + 1, False)]
)
def test_a_long_list_of_events_is_folded(count: int, opened: bool) -> None:
    from acsard.core.config.settings import Config

    report = ReportData(Config())
    for n in range(count):
        report.marks.add(Mark(float(n), f"name{n}", "text", "info", "", 1, None, float(n)))
    (details,) = [
        a
        for tag, a in PageElements(page(report, origin(), LIBRARY, clock)).tags
        if tag == "details"
    ]
    assert ("open" in details) is opened


def test_escaped_text_has_one_line() -> None:
    assert escaped('<a href="x">\n&') == "&lt;a href=&quot;x&quot;&gt; &amp;"
