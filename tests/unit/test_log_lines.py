"""Log lines: the first event at once, later ones as a count; text of strangers made harmless."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime, timedelta

from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.core.formatting import (
    json_line,
    lasting,
    lines,
    printable,
    printable_bytes,
    rough,
    utc,
)
from acsard.core.motion.event_throttle import BURST, MAX_LISTED, EventThrottle, merge
from acsard.core.values import NS_PER_S, Event
from tests.each import each

law = settings(max_examples=100)
MS = 1_000_000


def refused(reason: str = "stale", by: str = "joe", text: str = "late") -> Event:
    return Event("command_refused", text, "warning", by=by, kind=reason, news=False)


MODE = Event("mode", "why", kind="ready -> driving")


def logged(event: Event, seconds: float) -> list[Event]:
    """Repeat this event every 10 ms for this many seconds, and return the logged lines."""
    tally, told = EventThrottle(), list[Event]()
    for step in range(round(seconds * 100)):
        told += tally.lines([event], step * 10 * MS)
    return told


def test_a_single_event_is_reported_at_once_with_its_kind_and_its_count() -> None:
    event = Event("fault", "a wheel is dead", "error")
    assert EventThrottle().lines([event], 5) == (event,)
    late = Event("missed_periods", "29 in a row", kind="missed", count=29, news=False)
    line, other = EventThrottle().lines([late, MODE], 0)
    assert (line.text, line.count, line.news) == ("29 x missed: 29 in a row", 29, False)
    assert other.name == "mode"


def test_repeated_events_give_one_line_a_second_with_their_count() -> None:
    told = logged(refused(), 2.5)
    assert [line.count for line in told] == [1, 100, 100]
    assert told[0].text == "stale: late"
    assert told[1].text == "100 x stale; the last: late"


def test_a_waiting_line_comes_once_and_lists_the_kinds_and_the_senders() -> None:
    tally = EventThrottle()
    tally.lines([refused()], 0)
    waiting = [refused(by="ann"), refused(), refused("wildcard", text="a star")]
    assert tally.lines(waiting, 500 * MS) == tally.lines([], 999 * MS) == ()
    (line,) = tally.lines([], 1000 * MS)
    assert line.text == "2 x stale, 1 x wildcard; the last: a star"
    assert (line.by, line.count, line.level) == ("ann, joe", 3, "warning")
    assert tally.lines([], 5000 * MS) == ()
    bad = Event("link_check", "no answer", "error")
    (line,) = EventThrottle().lines([bad, Event("link_check", "fine")], 0)
    assert (line.level, line.text) == ("error", "2 times; the last: fine")


def test_kinds_and_senders_that_do_not_fit_are_others() -> None:
    crowd = [refused(f"reason{n}", by=f"sender{n}") for n in range(1000)]
    (line,) = EventThrottle().lines(crowd, 0)
    assert line.count == 1000
    assert f"{1000 - MAX_LISTED} x others" in line.text
    assert line.by.endswith(f"sender{MAX_LISTED - 1}, others")
    joined = refused(by="")
    for event in crowd[:100]:
        joined = merge(joined, event)
    assert joined.by.split(", ") == [*(f"sender{n}" for n in range(MAX_LISTED)), "others"]


def test_news_is_reported_at_once_until_it_comes_too_often_and_again_after_a_pause() -> None:
    told = logged(MODE, 10.0)
    assert [line.count for line in told[:BURST]] == [1] * BURST
    assert len(told) == BURST + 9
    tally = EventThrottle()
    for start_s in (0, 2 * BURST, 4 * BURST):
        for step in range(BURST):
            (line,) = tally.lines([MODE], start_s * NS_PER_S + step * MS)
            assert line.news
        assert tally.lines([MODE], start_s * NS_PER_S + BURST * MS) == ()
    # A line of news includes the events that waited.
    tally = EventThrottle()
    first = Event("activate", "active", by="joe")
    again = Event("activate", "active", by="ann", news=False)
    assert len(tally.lines([first], 0)) == 1
    assert tally.lines([again], 10 * MS) == ()
    (line,) = tally.lines([first], 20 * MS)
    assert (line.text, line.by, line.count) == ("2 times; the last: active", "ann, joe", 2)


events = st.builds(
    Event,
    st.sampled_from(["stop", "mode", "command_refused"]),
    st.text(max_size=3),
    by=st.text(max_size=2),
    kind=st.text(max_size=2),
    count=st.integers(1, 5),
    news=st.booleans(),
)


@law
@given(st.lists(st.tuples(st.integers(0, NS_PER_S), st.lists(events, max_size=4)), max_size=30))
def test_every_event_is_counted_and_no_second_has_more_lines_than_the_limit(
    steps: list[tuple[int, list[Event]]],
) -> None:
    tally, now_ns, told, at = EventThrottle(), 0, 0, list[tuple[str, int]]()
    for pause_ns, some in steps:
        now_ns += pause_ns
        for line in tally.lines(some, now_ns):
            told += line.count
            at.append((line.name, now_ns))
    told += sum(line.count for line in tally.lines([], now_ns + 2 * BURST * NS_PER_S))
    assert told == sum(event.count for _, some in steps for event in some)
    for name, start_ns in at:
        within = [t for n, t in at if n == name and start_ns <= t < start_ns + NS_PER_S]
        assert len(within) <= BURST + 1


# words

HOSTILE = "a\x1b]0;PWNED\x07b\x9b2J\u202ec\r\nd\te"
MOST = 64


def test_terminal_control_characters_are_replaced() -> None:
    assert printable(HOSTILE) == "a\ufffd]0;PWNED\ufffdb\ufffd2J\ufffdc  d e"
    assert lines(HOSTILE) == "a\ufffd]0;PWNED\ufffdb\ufffd2J\ufffdc \nd e"
    assert printable("Zürich, 8.5 °C") == "Zürich, 8.5 °C"


@each("data", [bytes(range(256)), b"\r\n", "é→`".encode(), b""])
def test_bytes_are_shown_as_printable_text_of_limited_length(data: bytes) -> None:
    text = printable_bytes(data, MOST)
    assert text.isprintable()
    assert text.removesuffix("…").isascii()
    assert len(text) <= MOST + 1
    assert text.endswith("…") == (len(data) > MOST)
    long = b"\xff" * MOST + b"end"  # whole escapes from its start or its end
    assert printable_bytes(long, MOST) == r"\xff" * (MOST // 4) + "…"
    assert printable_bytes(long, MOST, last=True) == "…" + r"\xff" * ((MOST - 3) // 4) + "end"


@law
@given(st.text(alphabet=st.characters(exclude_categories=["Cs"], max_codepoint=0xFFFF)))
def test_printable_json_decodes_to_the_same_value(text: str) -> None:
    line = json_line(json.dumps(text, ensure_ascii=False))
    assert json.loads(line) == text
    assert line.isprintable()
    assert json_line('"\U000e0001\U0001f916"') == '"\\udb40\\udc01\U0001f916"'


@each(
    ("seconds", "unit", "text"),
    [
        (0.0, 1e-6, "0.0 µs"), (63.1e-6, 1e-6, "63 µs"), (999.4e-6, 1e-6, "999 µs"),
        (999.6e-6, 1e-6, "1.0 ms"), (8.9125e-3, 1e-6, "8.9 ms"), (9.949e-3, 1e-6, "9.9 ms"),
        (9.96e-3, 1e-6, "10 ms"), (0.3328, 1e-6, "333 ms"), (2.5, 1e-6, "2.5 s"),
        (9900.0, 1e-6, "2.8 h"), (1e12, 1e-6, "?"), (-1.0, 1e-6, "?"), (math.nan, 1e-6, "?"),
        (None, 1.0, "never"), (math.inf, 1.0, "never"), (0.04, 1.0, "0.0 s"), (9.96, 1.0, "10 s"),
        (99.4, 1.0, "99 s"), (240.0, 1.0, "4.0 min"), (7300.0, 1.0, "2.0 h"), (9e5, 1.0, "10 d"),
    ],
)  # fmt: skip
def test_a_rough_duration_has_two_digits(seconds: float | None, unit: float, text: str) -> None:
    assert rough(seconds, unit) == text


@each(
    ("seconds", "text"),
    [
        (0.04, "0 s"), (3.0, "3 s"), (59.94, "59.9 s"), (59.96, "1 min"), (303.0, "5 min 3 s"),
        (3599.7, "1 h"), (3600.0 + 59.0, "1 h"), (7500.0, "2 h 5 min"), (2_592_000.0, "30 d"),
        (2_591_999.0, "29 d 23 h"),
    ],
)  # fmt: skip
def test_a_duration_has_its_two_largest_units(seconds: float, text: str) -> None:
    assert lasting(seconds) == text


@law
@given(st.datetimes(timezones=st.just(UTC)))
def test_a_time_is_written_as_date_and_time_in_utc(at: datetime) -> None:
    seconds = (at - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(seconds=1)
    assert utc(seconds * NS_PER_S) == f"{at:%Y-%m-%d %H:%M:%S} UTC".rjust(23, "0")
    assert utc(-1) == "1969-12-31 23:59:59 UTC"
    assert utc(951_782_400 * NS_PER_S + 999_999_999) == "2000-02-29 00:00:00 UTC"
