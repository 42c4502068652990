"""What the door sees of itself: what it tells, and when it has to be opened anew."""

from __future__ import annotations

from acsard.door.watch import ALONE_NS, STUCK_NS, TOLD_EVERY_NS, Look, Watch, crowd

S = 10**9
MOST = 4


def look(at_ns: int, *holders: str, linked: bool = True) -> Look:
    return Look(at_ns, holders, linked)


def test_a_door_with_room_has_nothing_to_tell() -> None:
    watch = Watch(MOST, 0)
    assert watch.judge(look(S, "ann", "ben", "ben")) is None
    assert watch.over(look(S), S + STUCK_NS) is None
    assert watch.crowded == 0


def test_a_door_without_room_tells_who_has_it_once_a_minute_and_counts_every_look() -> None:
    watch, told = Watch(MOST, 0), []
    for number in range(2 * 60 * 4 + 1):
        event = watch.judge(look(number * S // 4, "ben", "ann", "ben", ""))
        if event is not None:
            told.append((number * S // 4, event))
    assert [at for at, _ in told] == [0, TOLD_EVERY_NS, 2 * TOLD_EVERY_NS]
    _, event = told[0]
    assert (event.name, event.level) == ("door_crowded", "warning")
    assert event.text.startswith("all 4 connections are taken, 2 by ben, 1 by ann, 1 by an unnamed")
    assert watch.crowded == 2 * 60 * 4 + 1


def test_only_those_who_have_most_are_named() -> None:
    holders = [name for name in "abcdefgh" for _ in range(ord(name))]
    assert crowd(holders) == "104 by h, 103 by g, 102 by f, 101 by e, 100 by d"


def test_a_look_that_takes_too_long_ends_it() -> None:
    over = Watch(MOST, 0).over(look(S), S + STUCK_NS + 1)
    assert over is not None
    assert (over.name, over.level) == ("door_stuck", "error")


def test_without_the_daemon_it_closes() -> None:
    watch = Watch(MOST, 0)
    watch.judge(look(S))
    lonely = look(S + ALONE_NS, linked=False)
    watch.judge(lonely)
    assert watch.over(lonely, lonely.at_ns) is None, "it may be on its way back"
    later = look(S + ALONE_NS + 1, linked=False)
    over = watch.over(later, later.at_ns)
    assert over is not None
    assert over.name == "door_alone"


def test_a_daemon_that_is_back_in_time_keeps_it_open() -> None:
    watch = Watch(MOST, 0)
    for half_seconds in range(20):
        now = look(half_seconds * S // 2, linked=half_seconds % 2 == 0)
        watch.judge(now)
        assert watch.over(now, now.at_ns) is None
