"""Each of the daemon's events becomes exactly one line of the log."""

from __future__ import annotations

from msgspec.structs import replace

from acsard.core.messages.schema import Events, LogEvent, Time
from acsard.foxglove.relay import News
from tests.each import each

KEPT = 20


def events(total: int, of: str = "first") -> Events:
    """Return the daemon's events after this many of them."""
    kept = range(max(0, total - KEPT), total)
    told = [LogEvent(Time(n), f"mode{n}", "warning", f"{of} {n}", "ann", 1) for n in kept]
    return Events(Time(total), total, told)


def names(news: News, said: Events) -> list[str]:
    return [line.name for line in news.of(said)]


def test_who_opens_the_log_gets_all_that_is_still_known() -> None:
    lines = News().of(events(3))
    assert [(line.stamp.sec, line.level, line.name) for line in lines] == [
        (0, 30, "mode0"),
        (1, 30, "mode1"),
        (2, 30, "mode2"),
    ]
    assert lines[0].msg == "first 0 (by ann)"
    assert len(News().of(events(1000))) == KEPT


@each(("before", "now"), [(3, 4), (3, 3), (0, 5), (19, 23), (40, 60), (40, 55)])
def test_each_is_reported_once(before: int, now: int) -> None:
    news = News()
    news.of(events(before))
    assert names(news, events(now)) == [f"mode{n}" for n in range(before, now)]


def test_those_that_nobody_kept_are_gone() -> None:
    news = News()
    news.of(events(10))
    assert names(news, events(100)) == [f"mode{n}" for n in range(80, 100)]


def test_an_answer_that_is_older_than_what_came_by_itself_tells_nothing() -> None:
    news = News()
    news.of(events(10))
    assert names(news, events(9)) == []
    assert names(news, events(11)) == ["mode10"]


def test_one_that_goes_on_brings_nothing_old_back() -> None:
    news, fault = News(), events(1).events[0]
    missed = LogEvent(Time(5), "periods_missed", "warning", "3 more periods", "", 1)
    news.of(Events(Time(5), 2, [fault, missed]))
    later = replace(missed, stamp=Time(8), text="9 more periods")
    assert names(news, Events(Time(8), 4, [fault, later])) == ["periods_missed"]


def test_another_daemon_begins_anew() -> None:
    news = News()
    news.of(events(10))
    later = replace(events(2, "second"), stamp=Time(11))
    assert names(news, later) == ["mode0", "mode1"]
