"""`events`: recent events are kept, and a repeated one stays in one row."""

from __future__ import annotations

from msgspec.structs import replace

from acsard.core.config.settings import Config
from acsard.core.messages.recent_events import MAX_ROWS, RecentEvents
from acsard.core.messages.report import Report
from acsard.core.messages.schema import Events, LogEvent, Time
from acsard.core.motion.arbiter_text import missed
from acsard.core.values import NS_PER_S, Event, Instant
from tests.unit.examples import OUTPUTS, SNAPSHOT, START, due, later

FAULT = Event("fault", "a wheel is dead; `acsard call clear` releases it", "error")


def test_events_are_kept_without_subscribers_and_published_with_earlier_events() -> None:
    report = Report(Config(), START)
    many = tuple(Event("commander", f"the {n}. takes over", by="app", count=2) for n in range(25))
    assert not due(report, replace(OUTPUTS, events=many, due=False), set(), lambda: SNAPSHOT)
    assert not due(report, replace(OUTPUTS, events=()), {"events"}, lambda: SNAPSHOT)
    quiet = replace(OUTPUTS, now=later(7), due=False, estimates=())
    ((key, message),) = due(report, quiet, {"events"}, lambda: SNAPSHOT)
    assert isinstance(message, Events)
    assert (key, message.total, len(message.events)) == ("events", 26, 20)
    assert message.stamp == Time.from_ns(quiet.now.wall_ns)
    assert message.events[0] == LogEvent(
        Time.from_ns(OUTPUTS.now.wall_ns), "commander", "info", "the 6. takes over", "app", 2
    )
    assert message.events[-1] == LogEvent(message.stamp, "stop", "info", "stopped", "phone", 1)
    assert report.current("events", lambda: SNAPSHOT) == message


def rows_of(*events: tuple[float, Event]) -> list[tuple[str, int]]:
    """Return the names and counts of the rows after these events at these times, s."""
    recent = RecentEvents()
    assert recent.message() is None
    for seconds, event in events:
        ns = round(seconds * NS_PER_S)
        recent.add([event], Instant(ns, 1000 * NS_PER_S + ns))
    message = recent.message()
    assert message is not None
    assert message.total == len(events)
    return [(row.name, row.count) for row in message.events]


def test_a_repeated_event_stays_in_one_row_and_news_get_rows_of_their_own() -> None:
    late, stop = missed(3, 10_000_000), Event("stop", "stopped", by="ann")
    hour = [(float(second), late) for second in range(1, 3600)]
    assert rows_of((0, FAULT), *hour) == [("fault", 1), ("missed_periods", 3 * 3599)]
    # It moves after newer events, and after a minute without it, it is new.
    assert rows_of((0, late), (1, FAULT), (2, late)) == [("fault", 1), ("missed_periods", 6)]
    assert rows_of((0, late), (60, late), (121, late)) == [
        ("missed_periods", 6), ("missed_periods", 3),
    ]  # fmt: skip
    assert rows_of((0, stop), (1, stop), (2, replace(stop, news=False))) == [("stop", 1)] * 3
    many = [(float(n), Event("commander", f"{n}")) for n in range(MAX_ROWS + 5)]
    assert len(rows_of(*many)) == MAX_ROWS
