"""The bridge makes one log line of each event."""

from __future__ import annotations

from msgspec.structs import replace

from acsard.core.messages.schema import (
    Events,
    LogEvent,
    Time,
)
from acsard.foxglove.relay import EventDeduplicator
from tests.each import each

KEPT = 20


def events(total: int, of: str = "first") -> Events:
    """Return the daemon's recent events after this many events have happened."""
    numbers = range(max(0, total - KEPT), total)
    log_events = [LogEvent(Time(n), f"mode{n}", "warning", f"{of} {n}", "ann", 1) for n in numbers]
    return Events(Time(total), total, log_events)


def names(deduplicator: EventDeduplicator, report: Events) -> list[str]:
    return [line.name for line in deduplicator.of(report)]


def test_the_first_answer_gives_all_stored_events() -> None:
    lines = EventDeduplicator().of(events(3))
    assert [(line.stamp.sec, line.level, line.name) for line in lines] == [
        (0, 30, "mode0"),
        (1, 30, "mode1"),
        (2, 30, "mode2"),
    ]
    assert lines[0].msg == "first 0 (by ann)"
    assert len(EventDeduplicator().of(events(1000))) == KEPT


@each(("before", "now"), [(3, 4), (3, 3), (0, 5), (19, 23), (40, 60), (40, 55)])
def test_each_event_is_reported_once(before: int, now: int) -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(before))
    assert names(deduplicator, events(now)) == [f"mode{n}" for n in range(before, now)]


def test_events_that_the_daemon_no_longer_stores_are_skipped() -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(10))
    assert names(deduplicator, events(100)) == [f"mode{n}" for n in range(80, 100)]


def test_an_answer_older_than_the_last_message_reports_no_event() -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(10))
    assert names(deduplicator, events(9)) == []
    assert names(deduplicator, events(11)) == ["mode10"]


def test_an_event_that_is_updated_does_not_report_older_events_again() -> None:
    deduplicator, fault = EventDeduplicator(), events(1).events[0]
    missed = LogEvent(Time(5), "periods_missed", "warning", "3 more periods", "", 1)
    deduplicator.of(Events(Time(5), 2, [fault, missed]))
    later = replace(missed, stamp=Time(8), text="9 more periods")
    assert names(deduplicator, Events(Time(8), 4, [fault, later])) == ["periods_missed"]


def test_a_restarted_daemon_s_events_are_reported_from_the_first() -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(10))
    later = replace(events(2, "second"), stamp=Time(11))
    assert names(deduplicator, later) == ["mode0", "mode1"]


@each("total", [3, 4])
def test_a_restarted_daemon_that_has_logged_as_many_events_reports_all_of_them(total: int) -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(3))
    restarted = [replace(event, stamp=Time(10)) for event in events(total, "second").events]
    event_names = names(deduplicator, Events(Time(11), total, restarted))
    assert event_names == [f"mode{n}" for n in range(total)]
