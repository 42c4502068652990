"""A repeated event stays in one row, and a new event gets its own row."""

from __future__ import annotations

from acsard.core.messages.recent_events import MAX_ROWS, RecentEvents
from acsard.core.messages.schema import Events, Time
from acsard.core.motion.arbiter_text import missed
from acsard.core.values import NS_PER_S, Event, Instant

FAULT = Event("fault", "a wheel is dead; srv/clear releases it", "error")


def at(seconds: float) -> Instant:
    return Instant(round(seconds * NS_PER_S), round((1_000 + seconds) * NS_PER_S))


def message_of(happened: RecentEvents) -> Events:
    message = happened.message()
    assert message is not None
    return message


def names(happened: RecentEvents) -> list[str]:
    return [event.name for event in message_of(happened).events]


def test_without_events_there_is_no_message() -> None:
    assert RecentEvents().message() is None


def test_a_fault_is_still_listed_after_an_hour_of_missed_periods() -> None:
    happened = RecentEvents()
    happened.add([FAULT], at(0))
    for second in range(1, 3600):
        happened.add([missed(3, 10_000_000)], at(second))
    fault, others = message_of(happened).events
    assert (fault.name, fault.stamp) == ("fault", Time.from_ns(at(0).wall_ns))
    assert (others.name, others.count) == ("missed_periods", 3 * 3599)
    assert others.text.startswith(f"{3 * 3599} times; the last: late by 0.03 s: ")
    assert others.stamp == message_of(happened).stamp == Time.from_ns(at(3599).wall_ns)
    assert message_of(happened).total == 3600


def test_a_repeated_event_gets_a_new_row_after_a_minute_without_it() -> None:
    happened = RecentEvents()
    for second in (0, 60, 121):
        happened.add([missed(1, 10_000_000)], at(second))
    assert [event.count for event in message_of(happened).events] == [2, 1]


def test_a_repeated_event_moves_after_newer_events() -> None:
    happened = RecentEvents()
    happened.add([missed(1, 10_000_000)], at(0))
    happened.add([FAULT], at(1))
    assert names(happened) == ["missed_periods", "fault"]
    happened.add([missed(1, 10_000_000)], at(2))
    assert names(happened) == ["fault", "missed_periods"]


def test_events_that_are_news_are_never_combined() -> None:
    happened = RecentEvents()
    stop, clear = Event("stop", "stopped", by="ann"), Event("clear", "cleared", by="ann")
    for second in range(3):
        happened.add([stop, clear], at(second))
    happened.add([Event("stop", "stopped", by="joe", news=False)], at(3))
    assert names(happened) == ["stop", "clear"] * 3 + ["stop"]


def test_the_oldest_events_are_dropped_when_the_list_is_full() -> None:
    happened = RecentEvents()
    for second in range(MAX_ROWS + 5):
        happened.add([Event("commander", f"{second}")], at(second))
    assert [event.text for event in message_of(happened).events] == [
        str(n) for n in range(5, MAX_ROWS + 5)
    ]
    assert message_of(happened).total == MAX_ROWS + 5
