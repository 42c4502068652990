"""The throttle limits log lines: it logs the first event at once, and later ones as a count."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from acsard.core.motion.event_throttle import BURST, MAX_LISTED, EventThrottle, merge
from acsard.core.values import NS_PER_S, Event

MS = 1_000_000


def refused(reason: str = "stale", by: str = "joe", text: str = "late") -> Event:
    return Event("command_refused", text, "warning", by=by, kind=reason, news=False)


def mode(change: str = "ready -> driving") -> Event:
    return Event("mode", "why", kind=change)


def logged(events: list[Event], seconds: float, every_ms: int = 10) -> list[Event]:
    """Repeat these events every `every_ms` for this many seconds, and return the logged lines."""
    tally = EventThrottle()
    lines: list[Event] = []
    for step in range(round(seconds * 1000 / every_ms)):
        lines += tally.lines(events, step * every_ms * MS)
    return lines


def test_no_events_give_no_lines() -> None:
    assert logged([], 3.0) == []


def test_a_single_event_is_reported_immediately_and_unchanged() -> None:
    event = Event("fault", "a wheel is dead", "error")
    assert EventThrottle().lines([event], 5) == (event,)


def test_the_kind_of_an_event_precedes_its_text() -> None:
    (line,) = EventThrottle().lines([refused()], 0)
    assert (line.text, line.by, line.count) == ("stale: late", "joe", 1)
    assert line.level == "warning"


def test_repeated_events_give_one_line_a_second_with_their_count() -> None:
    lines = logged([refused()], 2.5)
    assert [line.count for line in lines] == [1, 100, 100]
    assert lines[1].text == "100 x stale; the last: late"


def test_a_waiting_event_is_reported_only_once_when_its_second_is_over() -> None:
    tally = EventThrottle()
    tally.lines([refused()], 0)
    assert tally.lines([refused()], 500 * MS) == ()
    assert tally.lines([], 999 * MS) == ()
    (line,) = tally.lines([], 1000 * MS)
    assert line.text == "stale: late"
    assert tally.lines([], 5000 * MS) == ()


def test_a_line_lists_the_kinds_and_the_senders_of_its_events() -> None:
    tally = EventThrottle()
    tally.lines([refused()], 0)
    tally.lines([refused(by="ann"), refused(), refused("wildcard", text="a star")], MS)
    (line,) = tally.lines([], NS_PER_S)
    assert line.text == "2 x stale, 1 x wildcard; the last: a star"
    assert (line.by, line.count) == ("ann, joe", 3)


def test_kinds_and_senders_that_do_not_fit_are_reported_as_others() -> None:
    many = [refused(f"reason{n}", by=f"sender{n}") for n in range(1000)]
    (line,) = EventThrottle().lines(many, 0)
    assert line.count == 1000
    assert f"{1000 - MAX_LISTED} x others" in line.text
    assert line.by.endswith(f"sender{MAX_LISTED - 1}, others")


def test_an_event_may_count_for_many() -> None:
    missed = Event("missed_periods", "29 in a row", kind="missed", count=29, news=False)
    (line,) = EventThrottle().lines([missed], 0)
    assert (line.text, line.count) == ("29 x missed: 29 in a row", 29)


def test_news_is_reported_immediately_until_it_comes_too_often() -> None:
    lines = logged([mode()], 10.0)
    assert [line.count for line in lines[:BURST]] == [1] * BURST
    assert len(lines) == BURST + 9
    assert sum(line.count for line in lines) <= 1000


def test_a_burst_after_a_pause_is_reported_in_full_again() -> None:
    tally = EventThrottle()
    for start_s in (0, 2 * BURST, 4 * BURST):
        for step in range(BURST):
            assert len(tally.lines([mode()], start_s * NS_PER_S + step * MS)) == 1
        assert tally.lines([mode()], start_s * NS_PER_S + BURST * MS) == ()


def test_a_line_of_news_includes_the_events_that_waited() -> None:
    tally = EventThrottle()
    first = Event("activate", "active", by="joe")
    again = Event("activate", "active", by="ann", news=False)
    assert len(tally.lines([first], 0)) == 1
    assert tally.lines([again], 10 * MS) == ()
    (line,) = tally.lines([first], 20 * MS)
    assert (line.text, line.by, line.count) == ("2 times; the last: active", "ann, joe", 2)


def test_events_of_different_names_do_not_delay_each_other() -> None:
    lines = EventThrottle().lines([refused(), mode()], 0)
    assert [line.name for line in lines] == ["command_refused", "mode"]


def test_a_line_has_the_highest_level_of_its_events() -> None:
    good, bad = Event("link_check", "fine"), Event("link_check", "no answer", "error")
    (line,) = EventThrottle().lines([bad, good], 0)
    assert (line.level, line.text) == ("error", "2 times; the last: fine")


def test_a_line_is_news_only_if_its_event_is_news() -> None:
    (again,), (news,) = EventThrottle().lines([refused()], 0), EventThrottle().lines([mode()], 0)
    assert not again.news
    assert news.news


def test_two_joined_lines_have_the_total_count_and_the_last_text() -> None:
    kind = "12 x stale; the last"
    first = Event("command_refused", f"{kind}: late", "info", "joe, ann", kind, 12)
    kind = "3 x wildcard"
    other = Event("command_refused", f"{kind}: a star", "warning", "ann, eve", kind, 3)
    line = merge(first, other)
    assert (line.text, line.count) == ("15 times; the last: a star", 15)
    assert (line.by, line.level) == ("joe, ann, eve", "warning")
    assert merge(line, refused()).text == "16 times; the last: late"
    assert merge(refused(), line).text == "16 times; the last: a star"


def test_joined_lines_of_many_senders_name_only_a_few() -> None:
    line = refused(by="")
    for number in range(100):
        line = merge(line, refused(by=f"sender{number}"))
    assert line.by.split(", ") == [*(f"sender{n}" for n in range(MAX_LISTED)), "others"]


events = st.builds(
    Event,
    st.sampled_from(["stop", "mode", "command_refused"]),
    st.text(max_size=3),
    by=st.text(max_size=2),
    kind=st.text(max_size=2),
    count=st.integers(1, 5),
    news=st.booleans(),
)


@given(st.lists(st.tuples(st.integers(0, NS_PER_S), st.lists(events, max_size=4)), max_size=40))
def test_every_event_is_counted_and_no_second_has_more_lines_than_the_limit(
    steps: list[tuple[int, list[Event]]],
) -> None:
    tally, now_ns = EventThrottle(), 0
    given_, told_, at = 0, 0, []
    for pause_ns, some in steps:
        now_ns += pause_ns
        given_ += sum(event.count for event in some)
        for line in tally.lines(some, now_ns):
            told_ += line.count
            at.append((line.name, now_ns))
    told_ += sum(line.count for line in tally.lines([], now_ns + 2 * BURST * NS_PER_S))
    assert told_ == given_
    for name, start_ns in at:
        within = [t for n, t in at if n == name and start_ns <= t < start_ns + NS_PER_S]
        assert len(within) <= BURST + 1
