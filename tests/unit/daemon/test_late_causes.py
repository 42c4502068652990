"""The daemon finds each cause of lateness in the kernel's files, and no cause in normal load."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from acsard.daemon.late_causes import (
    BECAUSE,
    CAUSES,
    LatenessEvidence,
    cause_in,
    causes,
    event_of,
    present,
)
from acsard.host.kernel_counters import Conditions, Kernel, Program, Reading, Scheduled, SlowClock
from tests.each import each
from tests.unit.host.kernel_files import (
    CGROUP,
    COOLER,
    COUNT,
    FIRMWARE,
    HWMON,
    IO,
    OWN_IO,
    OWN_STAT,
    POLICY,
    PRESSURE,
    QUIET,
    own,
    stat,
    write,
)

MS = 1_000_000

SIZES_MS = [12, 20, 35, 60, 100, 160, 250, 1000]
"""Durations of the latenesses that are judged."""

NORMAL = Path(__file__).parent / "normal_load.jsonl"
"""Latenesses that a program made by sleeping on a busy machine, so that the kernel has no cause.

`python -m tests.unit.daemon.normal_load` records them.
"""

RAN = (1.0, 0.0)
"""Shares of a lateness in which the loop's thread ran, and in which it waited for a processor."""

WAITED = (0.0, 1.0)
SLEPT = (0.0, 0.0)


def planted(late_ms: int) -> dict[str, tuple[dict[str, str], tuple[float, float]]]:
    """Return for each cause the kernel files that change and the activity of the loop's thread."""
    ticks = max(3, late_ms // 10)
    return {
        "undervoltage": ({HWMON + "in0_lcrit_alarm": "1\n", FIRMWARE: "50005\n"}, RAN),
        "heat": ({COUNT: "9\n", COOLER + "cur_state": "2\n"}, RAN),
        "governor": ({POLICY + "scaling_governor": "powersave\n"}, RAN),
        "quota": ({CGROUP: f"throttled_usec {late_ms * 1000}\n"}, WAITED),
        "steal": ({"proc/stat": stat(steal=18419 + ticks)}, WAITED),
        "memory": ({OWN_STAT: own(faults=11)}, SLEPT),
        "disk": (
            {
                "proc/pressure/io": PRESSURE.format(some=715587067 + late_ms * 1000),
                OWN_IO: IO.format(read=1 << 20),
            },
            SLEPT,
        ),
        "processor": ({}, WAITED),
    }


def judged(root: Path, name: str, late_ms: int) -> LatenessEvidence:
    """Return the judgement of a late period with one simulated cause."""
    files, (ran, waited) = planted(late_ms)[name]
    kernel, late_ns = Kernel(write(root, QUIET)), late_ms * MS
    before = kernel.read()
    write(root, files)
    loop = Scheduled(int(ran * late_ns) + 200_000, int(waited * late_ns))
    return LatenessEvidence(late_ns, loop, before, kernel.read())


@pytest.mark.parametrize("name", planted(10))
def test_a_planted_cause_is_named_eight_of_eight_times(name: str, tmp_path: Path) -> None:
    for late_ms in SIZES_MS:
        late = judged(tmp_path / str(late_ms), name, late_ms)
        names, clause = causes(late)
        assert names == (name,), late_ms
        assert clause


def test_a_suspend_is_named_eight_of_eight_times(tmp_path: Path) -> None:
    before = Kernel(write(tmp_path, QUIET)).read()
    for late_ms in SIZES_MS:
        after = replace(before, asleep_ns=before.asleep_ns + 12_300 * MS)
        names, clause = causes(LatenessEvidence(late_ms * MS, Scheduled(), before, after))
        assert names == ("suspended",)
        assert "suspended for 12.30 s" in clause


def test_every_cause_of_the_table_is_planted() -> None:
    assert {cause.name for cause in CAUSES} == {"suspended", *planted(10)}


@each("late_ms", SIZES_MS)
@each("share", [RAN, WAITED, SLEPT])
def test_a_quiet_computer_has_no_cause_but_waiting_for_a_processor(
    late_ms: int, share: tuple[float, float]
) -> None:
    loop = Scheduled(int(share[0] * late_ms * MS), int(share[1] * late_ms * MS))
    names, clause = causes(LatenessEvidence(late_ms * MS, loop, Reading(), Reading()))
    assert names == (("processor",) if share == WAITED else ())
    assert bool(clause) == bool(names)


def test_normal_load_has_no_false_cause() -> None:
    recorded = [
        msgspec.json.decode(line, type=LatenessEvidence)
        for line in NORMAL.read_bytes().splitlines()
    ]
    assert len(recorded) >= 200
    assert max(lateness.late_ns for lateness in recorded) > 150 * MS
    assert [causes(lateness) for lateness in recorded if causes(lateness)[0]] == []


def test_the_recorded_load_is_not_idle() -> None:
    recorded = [
        msgspec.json.decode(line, type=LatenessEvidence)
        for line in NORMAL.read_bytes().splitlines()
    ]
    assert sum(lateness.after.disk_ns > lateness.before.disk_ns for lateness in recorded) > 20
    assert sum(lateness.after.steal_ns > lateness.before.steal_ns for lateness in recorded) > 0
    assert sum(lateness.loop.waited_ns > 0 for lateness in recorded) > 20


@pytest.mark.parametrize(
    "conditions",
    [
        Conditions(undervoltage=True),
        Conditions(slowed_by_heat=True),
        Conditions(throttled=1),
        Conditions(slow_clock=SlowClock("powersave", 600, 1500)),
    ],
)
def test_a_slow_processor_delays_no_thread_that_slept(conditions: Conditions) -> None:
    after = Reading(conditions=conditions)
    assert causes(LatenessEvidence(30 * MS, Scheduled(200_000, 0), Reading(), after))[0] == ()
    assert len(causes(LatenessEvidence(30 * MS, Scheduled(20 * MS, 0), Reading(), after))[0]) == 1


def test_a_disk_is_no_cause_for_a_thread_that_ran_or_did_not_use_the_disk() -> None:
    after = Reading(disk_ns=250 * MS, own_bytes=4096)
    assert causes(LatenessEvidence(30 * MS, Scheduled(), Reading(), after))[0] == ("disk",)
    assert causes(LatenessEvidence(30 * MS, Scheduled(25 * MS, 0), Reading(), after))[0] == ()
    others = replace(after, own_bytes=0)
    assert causes(LatenessEvidence(30 * MS, Scheduled(), Reading(), others))[0] == ()


def test_the_thread_s_own_disk_delay_is_enough_to_name_the_disk() -> None:
    after = Reading(own_disk_ns=20 * MS)
    assert causes(LatenessEvidence(30 * MS, Scheduled(), Reading(), after))[0] == ("disk",)
    assert causes(LatenessEvidence(50 * MS, Scheduled(), Reading(), after))[0] == ()


@pytest.mark.parametrize(("stolen_ms", "named"), [(10, False), (20, False), (30, True)])
def test_one_or_two_ticks_of_steal_time_are_not_named_as_a_cause(
    stolen_ms: int, named: bool
) -> None:
    late = LatenessEvidence(
        12 * MS, Scheduled(), Reading(0, (5, 5)), Reading(0, (5, 5 + stolen_ms * MS))
    )
    assert causes(late)[0] == (("steal",) if named else ())


def test_two_simultaneous_causes_are_both_named() -> None:
    conditions = Conditions(slow_clock=SlowClock("powersave", 600, 1500))
    hog = Program(812, "hog", 150 * MS)
    late = LatenessEvidence(
        50 * MS, Scheduled(0, 50 * MS), Reading(), Reading(conditions=conditions), hog
    )
    names, clause = causes(late)
    assert names == ("governor", "processor")
    assert "powersave keeps the processor at 600 of 1500 MHz" in clause
    assert "for 0.05 s, most of all the program hog (pid 812)" in clause


def test_a_real_time_program_is_reported_as_real_time() -> None:
    hog = Program(812, "hog", 150 * MS, -21)
    late = LatenessEvidence(50 * MS, Scheduled(0, 50 * MS), Reading(), Reading(), hog)
    assert "the real-time program hog (pid 812)" in causes(late)[1]


def test_the_event_has_the_duration_and_the_cause_with_its_advice() -> None:
    after = Reading(conditions=Conditions(undervoltage=True))
    late = LatenessEvidence(63 * MS, Scheduled(60 * MS, 0), Reading(), after)
    event = event_of(late, causes(late)[1], immediate=True)
    assert (event.name, event.level, event.kind) == ("missed_periods", "warning", "late")
    assert BECAUSE in event.text
    assert event.text == (
        "by 0.06 s, because the supply voltage is too low, which slows the processor "
        "(use a stronger power supply and a shorter cable)"
    )


@pytest.mark.parametrize(
    "line",
    [
        "{}",
        "late: {}",
        "11 x missed, 1 x late; the last: {}",
        "23 times; the last: late: {}",
    ],
)
def test_the_cause_is_parsed_from_each_form_of_a_log_line(line: str) -> None:
    cause = "by 0.06 s, because the processor is hot (cool it: now), and it is slow (speed it)"
    assert cause_in(line.format(cause)) == cause
    assert cause_in("11 x missed: no control step ran in 11 successive control periods") == ""


def test_present_causes_are_listed_without_a_late_period() -> None:
    before, second = Reading(0, (0, 0)), 1000 * MS
    assert present(before, before, second) == []
    low = replace(before, conditions=Conditions(undervoltage=True, throttled=1))
    assert [clause for clause, _ in present(before, low, second)] == [
        "the supply voltage is too low, which slows the processor",
        "the processor is too hot and runs slower",
    ]
    ((clause, advice),) = present(before, replace(before, steal_ns=(0, 30 * MS)), second)
    assert "the host gave this virtual machine" in clause
    assert "processor of its own" in advice
    assert present(before, replace(before, steal_ns=(0, 10 * MS)), second) == []
