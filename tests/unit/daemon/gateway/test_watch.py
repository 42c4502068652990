"""Tests of the TLS gateway's watch over itself.

It reports events and finds reasons to reopen the gateway.
"""

from __future__ import annotations

from acsard.daemon.gateway.watch import (
    ALONE_NS,
    FIRST_NS,
    STUCK_NS,
    UNANSWERED,
    Look,
    Watch,
    crowd,
)

S = 10**9
MOST = 4


def look(at_ns: int, *holders: str, linked: bool = True) -> Look:
    return Look(at_ns, holders, linked)


def test_a_gateway_with_room_has_nothing_to_tell() -> None:
    watch = Watch(MOST, 0)
    assert watch.tell(look(S, "ann", "ben", "ben")) is None
    assert watch.reopen(look(S), S // 4) is None
    assert watch.full == 0


def test_a_gateway_without_room_tells_who_has_it_once_a_minute_and_counts_every_look() -> None:
    watch, told = Watch(MOST, 0), []
    for number in range(2 * 60 * 4 + 1):
        event = watch.tell(look(number * S // 4, "ben", "ann", "ben", ""))
        if event is not None:
            told.append((number * S // 4, event))
    assert [at for at, _ in told] == [0, 60 * S, 120 * S]
    _, event = told[0]
    assert (event.name, event.level) == ("gateway_full", "warning")
    assert event.text.startswith("all 4 connections are taken, 2 by ben, 1 by ann, 1 by an unnamed")
    assert watch.full == 2 * 60 * 4 + 1


def test_only_those_who_have_most_are_named() -> None:
    holders = [name for name in "abcdefgh" for _ in range(ord(name))]
    assert crowd(holders) == "104 by h, 103 by g, 102 by f, 101 by e, 100 by d"


MOMENT = S // 4


def test_a_look_that_takes_too_long_ends_it() -> None:
    watch, stuck = Watch(MOST, 0), look(S)
    assert [watch.reopen(stuck, MOMENT) for _ in range(STUCK_NS // MOMENT + 1)][-1] is None
    over = watch.reopen(stuck, MOMENT)
    assert over is not None
    assert (over.name, over.level) == ("gateway_stuck", "error")


def test_a_machine_that_stands_still_as_a_whole_is_nobody_s_fault() -> None:
    watch = Watch(MOST, 0)
    assert watch.reopen(look(S), MOMENT) is None
    assert watch.reopen(look(S), 60 * S) is None
    assert watch.reopen(look(61 * S), MOMENT) is None


def test_a_daemon_that_is_connected_and_answers_nothing_is_none() -> None:
    watch = Watch(MOST, 0)
    for number in range(UNANSWERED):
        assert watch.reopen(Look(S, linked=True, unanswered=number), 0) is None
    over = watch.reopen(Look(S, linked=True, unanswered=UNANSWERED), 0)
    assert over is not None
    assert (over.name, over.level) == ("gateway_lost_daemon", "warning")
    assert "4 queries unanswered" in over.text


def test_without_the_daemon_it_closes() -> None:
    watch = Watch(MOST, 0)
    assert watch.reopen(look(S), MOMENT) is None
    assert watch.reopen(look(S + ALONE_NS, linked=False), MOMENT) is None, "it may come back"
    over = watch.reopen(look(S + ALONE_NS + 1, linked=False), MOMENT)
    assert over is not None
    assert over.name == "gateway_lost_daemon"


def test_while_others_come_in_too_the_daemon_has_more_time() -> None:
    watch = Watch(MOST, S)
    assert watch.reopen(look(S + FIRST_NS, linked=False), MOMENT) is None
    assert watch.reopen(look(S + FIRST_NS + 1, linked=False), MOMENT) is not None


def test_a_daemon_that_is_back_in_time_keeps_it_open() -> None:
    watch = Watch(MOST, 0)
    for half_seconds in range(20):
        now = look(half_seconds * S // 2, linked=half_seconds % 2 == 0)
        assert watch.reopen(now, MOMENT) is None
