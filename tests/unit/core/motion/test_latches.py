"""Causes are added with new numbers, and a release removes exactly those that it names."""

from __future__ import annotations

from msgspec.structs import replace

from acsard.core.codes import reason
from acsard.core.motion.latches import (
    MAX_CAUSES,
    after_restart,
    describe,
    in_force,
    latched,
    released,
    stopped,
)
from acsard.core.values import Latches

WALL_NS = 1_800_000_000_000_000_000
DEAD = reason("wheel_reversed", part="front_left", wheel="front_left", figures="(1)")
FLAT = reason("battery_empty", threshold="22 V", charged="24 V")


def numbers(latches: Latches) -> list[int]:
    return [cause.number for cause in latches.causes]


def test_each_cause_has_a_new_number_and_the_last_number_stays_after_a_release() -> None:
    latches = stopped(Latches(last=41), "joe", WALL_NS)
    latches = latched(latches, "fault", DEAD, WALL_NS)
    assert numbers(latches) == [42, 43]
    latches = released(latches, {42, 43, 7})
    assert latches == Latches((), 43)
    assert numbers(stopped(latches, "joe", WALL_NS)) == [44]


def test_a_release_leaves_what_it_does_not_name() -> None:
    latches = Latches()
    for name in ("ann", "joe", "eve"):
        latches = stopped(latches, name, WALL_NS)
    assert numbers(released(latches, [2])) == [1, 3]


def test_the_same_cause_renews_its_number_and_is_there_once() -> None:
    latches = stopped(Latches(), "joe", WALL_NS)
    latches = latched(latches, "stop", FLAT, WALL_NS)
    latches = stopped(latches, "ann", WALL_NS)
    latches = stopped(latches, "joe", WALL_NS + 1)
    assert [(cause.by, cause.number) for cause in latches.causes] == [
        ("", 2),
        ("ann", 3),
        ("joe", 4),
    ]
    assert latches.causes[-1].at_ns == WALL_NS + 1


def test_wheels_of_one_fault_are_several_causes_and_two_who_switch_off_are_one() -> None:
    latches = latched(Latches(), "fault", DEAD, WALL_NS)
    other = replace(DEAD, part="rear_left")
    latches = latched(latches, "fault", other, WALL_NS)
    for name in ("ann", "joe"):
        off = reason("switched_off", by=name)
        latches = latched(latches, "inactive", off, WALL_NS, name)
    assert [(cause.part, cause.by) for cause in latches.causes] == [
        ("front_left", ""),
        ("rear_left", ""),
        ("", "joe"),
    ]


def test_of_too_many_causes_the_newest_stop_of_a_client_goes() -> None:
    latches = latched(Latches(), "fault", DEAD, WALL_NS)
    for number in range(100):
        latches = stopped(latches, f"client{number}", WALL_NS)
    assert len(latches.causes) == MAX_CAUSES
    assert [latches.causes[place].by for place in (0, 1, -2, -1)] == [
        "",
        "client0",
        "client29",
        "client99",
    ]
    latches = latched(latches, "stop", FLAT, WALL_NS)
    assert [latches.causes[place].code for place in (0, -1)] == ["wheel_reversed", "battery_empty"]
    assert latches.last == 102


def test_a_cause_says_in_words_what_holds_the_robot_and_since_when() -> None:
    latches = latched(Latches(), "fault", DEAD, WALL_NS)
    latches = stopped(latched(latches, "stop", FLAT, WALL_NS), "", WALL_NS)
    dead, flat, stop = latches.causes
    assert describe(dead).endswith("(1) (latched at 2027-01-15 08:00:00 UTC)")
    assert describe(flat) == "battery below 22 V (latched at 2027-01-15 08:00:00 UTC)"
    assert describe(stop) == "stopped by request at 2027-01-15 08:00:00 UTC"
    (*_, kept) = after_restart(latches).causes
    assert describe(kept) == (
        "was stopped by request at 2027-01-15 08:00:00 UTC, before the restart"
    )
    assert in_force([flat, stop]) == "stopped (battery below 22 V) and stopped by request"
    assert in_force([stop, dead]).startswith(
        "in fault (front_left wheel does not obey its command: it"
    )
