"""Tests of the order in which recordings are deleted.

The oldest recording is deleted first, and protected ones last. A part of the disk stays free for
other programs.
"""

from __future__ import annotations

import math

from acsard.core.values import NS_PER_S, Instant
from acsard.recording.retention import (
    INCIDENT_MARGIN_NS,
    MAX_KEPT_FILES,
    MIN_FILE_BYTES,
    STEADY_CLOCK_NS,
    Bounds,
    ClockWatch,
    Disk,
    FinishedFile,
    IncidentWindow,
    Kind,
    file_size_limit,
    to_delete,
)

WIDE = Disk(10**12, 10**12)
BOUNDS = Bounds(10**10, -math.inf)
DAY_NS = 86_400 * NS_PER_S


def files(*kinds: Kind, size: int = 1000, this_run: bool = False) -> list[FinishedFile]:
    return [
        FinishedFile(str(number), number, kind, size, 100.0 * number, this_run)
        for number, kind in enumerate(kinds, 1)
    ]


def test_nothing_is_deleted_while_there_is_room() -> None:
    assert to_delete(files("plain", "kept", "near"), BOUNDS, WIDE) == set()


def test_the_oldest_files_go_first_and_protected_files_last() -> None:
    ended = files("kept", "near", "plain", "plain", "plain")
    bounds = Bounds(3000 + MIN_FILE_BYTES, -math.inf)
    assert to_delete(ended, bounds, WIDE) == {"3", "4"}
    assert to_delete(ended, bounds._replace(size=1000 + MIN_FILE_BYTES), WIDE) == {
        "1",
        "3",
        "4",
        "5",
    }


def test_near_files_are_protected_while_their_incident_is_protected() -> None:
    turns: list[Kind] = ["plain", "kept"]
    ended = files("near", "kept", "near", *turns * MAX_KEPT_FILES)
    old = Bounds(10**10, math.inf)
    assert to_delete(ended, old, WIDE) == {file.name for file in ended if file.kind != "kept"} | {
        "2"
    }
    assert {"1", "3"} & to_delete(ended[:-1], old, WIDE) == set()


def test_only_files_of_earlier_runs_can_be_too_old() -> None:
    bounds = BOUNDS._replace(oldest_s=250.0)
    assert to_delete(files("plain", "plain", "plain"), bounds, WIDE) == {"1", "2"}
    assert to_delete(files("plain", "plain", "plain", this_run=True), bounds, WIDE) == set()


def test_protected_files_and_the_newest_do_not_make_room_for_other_programs() -> None:
    ended = files("kept", "plain", "plain", "plain", "plain")
    disk = Disk(100_000, 5000)
    assert to_delete(ended, BOUNDS, disk) == set()
    assert to_delete(ended, BOUNDS, disk._replace(free=3500)) == {"2", "3"}
    assert to_delete(ended, BOUNDS, disk._replace(free=1000)) == {"2", "3", "4"}


def test_if_the_disk_is_nearly_full_all_files_make_room_for_the_next() -> None:
    ended = files("kept", "plain", "near", size=400)
    assert to_delete(ended, BOUNDS, Disk(100_000, 0)) == {"1", "2", "3"}
    assert to_delete(ended, BOUNDS, Disk(100_000, 300)) == {"2", "3"}


def test_if_even_deleting_all_files_frees_too_little_incidents_and_this_run_are_kept() -> None:
    full = Disk(100_000, 0)
    ended = files("kept", "near", "plain", size=333)
    assert to_delete(ended, BOUNDS, full) == {"3"}
    assert to_delete(ended, BOUNDS, full, freed=0) == {"3"}
    for freed in (None, 0):
        this_run = files("plain", "kept", "plain", size=333, this_run=True)
        assert to_delete(this_run, BOUNDS, full, freed) == set()
    assert to_delete(ended, BOUNDS, full._replace(free=1)) == {"1", "2", "3"}
    assert to_delete(ended, BOUNDS._replace(size=MIN_FILE_BYTES), full) == {"1", "2", "3"}


def test_a_disk_that_refuses_despite_free_space_gets_one_file_deleted() -> None:
    assert to_delete(files("kept", "plain", "plain"), BOUNDS, WIDE, freed=0) == {"2"}
    assert to_delete(files("kept"), BOUNDS, WIDE, freed=0) == {"1"}
    assert to_delete([], BOUNDS, WIDE, freed=0) == set()


def test_a_disk_that_keeps_refusing_gets_no_protected_file_and_at_most_one_more() -> None:
    assert to_delete(files("kept", "plain", "plain"), BOUNDS, WIDE, freed=1) == {"2"}
    assert to_delete(files("kept", "near"), BOUNDS, WIDE, freed=1) == set()
    assert to_delete(files("kept", "plain"), BOUNDS, WIDE, freed=MIN_FILE_BYTES) == set()
    low = Disk(100_000, 300)
    assert to_delete(files("kept", "near", size=400), BOUNDS, low, freed=1) == {"1", "2"}


def test_a_file_may_take_a_hundredth_of_the_total_size() -> None:
    assert file_size_limit(10**9, 0, WIDE) == 10**7
    assert file_size_limit(10**9, 10**8, Disk(10**9, 15 * 10**7)) == 2 * 10**6
    assert file_size_limit(10**9, 0, Disk(10**6, 0)) == MIN_FILE_BYTES


def test_other_programs_keep_a_gigabyte_of_a_large_disk() -> None:
    assert Disk(10**12, 10**9).low is False
    assert Disk(10**12, 10**9 - 1).low is True
    assert Disk(10**9, 10**8).low is False


def test_a_clock_is_trusted_a_while_after_its_last_jump() -> None:
    clock = ClockWatch()
    assert not clock.trusted(Instant(STEADY_CLOCK_NS, 0))
    assert clock.jump_ns(Instant(0, DAY_NS)) == 0
    assert not clock.trusted(Instant(STEADY_CLOCK_NS - 1, DAY_NS))
    assert (
        clock.jump_ns(Instant(STEADY_CLOCK_NS, DAY_NS + STEADY_CLOCK_NS + NS_PER_S)) == 0
    )  # the clock drifts
    assert clock.trusted(Instant(STEADY_CLOCK_NS, DAY_NS))
    assert (
        clock.jump_ns(Instant(STEADY_CLOCK_NS, 3 * DAY_NS + STEADY_CLOCK_NS + NS_PER_S))
        == 2 * DAY_NS
    )
    assert not clock.trusted(Instant(STEADY_CLOCK_NS + 1, 3 * DAY_NS))


def kind(around: IncidentWindow[str]) -> Kind:
    """Return the kind of the file that is being written now."""
    return around.kind


def test_a_file_that_ended_less_than_a_minute_before_an_incident_is_retained_once() -> None:
    around = IncidentWindow[str]()
    for number in range(4):
        around.begin(number * INCIDENT_MARGIN_NS // 2)
        around.end(str(number), (number + 1) * INCIDENT_MARGIN_NS // 2)
    around.begin(2 * INCIDENT_MARGIN_NS)
    assert around.happened(2 * INCIDENT_MARGIN_NS + 1) == ["2", "3"]
    assert kind(around) == "kept"
    assert around.happened(2 * INCIDENT_MARGIN_NS + 2) == []


def test_a_file_that_begins_less_than_a_minute_after_an_incident_is_near() -> None:
    around = IncidentWindow[str]()
    around.begin(0)
    assert kind(around) == "plain"
    around.happened(10)
    around.end("it", 20)
    around.begin(9 + INCIDENT_MARGIN_NS)
    assert kind(around) == "near"
    around.end("near", 10 + INCIDENT_MARGIN_NS)
    around.begin(10 + INCIDENT_MARGIN_NS)
    assert kind(around) == "plain"
    assert around.happened(10 + INCIDENT_MARGIN_NS) == []


def test_incidents_count_over_a_restart() -> None:
    around = IncidentWindow[str]()
    around.earlier("plain", "plain", -5)
    around.earlier("near", "near", -5)
    around.begin(0)
    assert kind(around) == "plain"
    assert around.happened(1) == ["plain"]
    other = IncidentWindow[str]()
    other.earlier("kept", "kept", -5)
    other.begin(0)
    assert kind(other) == "near"


def test_a_crash_before_this_run_is_an_incident() -> None:
    around = IncidentWindow[str]()
    around.earlier_happened(-INCIDENT_MARGIN_NS)
    around.begin(0)
    assert kind(around) == "plain"
    around.earlier_happened(1 - INCIDENT_MARGIN_NS)
    around.begin(0)
    assert kind(around) == "near"
