"""The daemon parses the kernel's files into values. A missing file counts as zeros."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.host.kernel_counters import (
    Conditions,
    Kernel,
    Program,
    Reading,
    Scheduled,
    SlowClock,
    busiest,
    program,
    quota,
    scheduled,
    slow_clock,
)
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
    QUIET,
    own,
    stat,
    write,
)

MS = 1_000_000
TICK = 10 * MS


def conditions(root: Path, **files: str) -> Conditions:
    return Kernel(write(root, QUIET | files)).conditions()


def test_every_counter_of_a_quiet_computer_is_read(tmp_path: Path) -> None:
    reading = Kernel(write(tmp_path, QUIET)).read()
    assert reading.asleep_ns >= 0
    assert reading == Reading(
        reading.asleep_ns,
        (18419 * TICK, 19567 * TICK),
        715587067_000,
        0,
        8192 + 4096,
        3,
        0,
        Conditions(throttled=2),
    )


def test_a_computer_without_these_files_has_zeros(tmp_path: Path) -> None:
    reading = Kernel(tmp_path).read()
    assert reading == Reading(reading.asleep_ns)


def test_this_computer_has_the_files_that_every_linux_has() -> None:
    reading = Kernel().read()
    assert len(reading.steal_ns) >= 1
    assert any(process.pid == 1 for process in Kernel().programs())


def test_given_conditions_replace_those_of_the_files(tmp_path: Path) -> None:
    kernel = Kernel(write(tmp_path, QUIET | {HWMON + "in0_lcrit_alarm": "1\n"}))
    assert kernel.read(Conditions()).conditions == Conditions()
    assert kernel.read().conditions.undervoltage


def test_without_pressure_stall_information_the_idle_time_with_io_counts(tmp_path: Path) -> None:
    files = {name: text for name, text in QUIET.items() if "pressure" not in name}
    kernel = Kernel(write(tmp_path, files))
    assert kernel.read().disk_ns == 17685 * TICK
    write(tmp_path, {"proc/stat": stat(iowait=17690)})
    assert kernel.read().disk_ns == 17690 * TICK


def test_the_disk_delays_and_bytes_of_the_own_thread_are_read(tmp_path: Path) -> None:
    files = {OWN_STAT: own(faults=9, blocked=7), OWN_IO: IO.format(read=1 << 20)}
    reading = Kernel(write(tmp_path, QUIET | files)).read()
    assert (reading.major_faults, reading.own_disk_ns) == (9, 7 * TICK)
    assert reading.own_bytes == (1 << 20) + 4096


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({HWMON + "in0_lcrit_alarm": "1\n"}, Conditions(undervoltage=True, throttled=2)),
        ({FIRMWARE: "50005\n"}, Conditions(undervoltage=True, throttled=2)),
        # The firmware remembers low voltages and heat of the past, which cause nothing now.
        ({FIRMWARE: "f0000\n"}, Conditions(throttled=2)),
        ({FIRMWARE: "80008\n"}, Conditions(slowed_by_heat=True, throttled=2)),
        ({FIRMWARE: "e0006\n"}, Conditions(slowed_by_heat=True, throttled=2)),
        ({COOLER + "cur_state": "2\n"}, Conditions(slowed_by_heat=True, throttled=2)),
        ({COUNT: "5\n"}, Conditions(throttled=5)),
        (
            {POLICY + "scaling_governor": "powersave\n"},
            Conditions(throttled=2, slow_clock=SlowClock("powersave", 600, 1500)),
        ),
    ],
)
def test_each_condition_is_read_from_its_file(
    files: dict[str, str], expected: Conditions, tmp_path: Path
) -> None:
    assert conditions(tmp_path, **files) == expected


@pytest.mark.parametrize(
    ("driver", "governor", "highest", "limit"),
    [
        ("cpufreq-dt", "ondemand", "1500000", None),
        ("cpufreq-dt", "ondemand", "900000", None),
        ("cpufreq-dt", "schedutil", "800000", 800),
        ("cpufreq-dt", "powersave", "1500000", 600),
        ("cpufreq-dt", "userspace", "1500000", 700),
        # This driver chooses the clock by the load with the governor of this name.
        ("intel_pstate", "powersave", "1500000", None),
    ],
)
def test_a_clock_is_slow_if_its_limit_is_far_below_the_full_clock(
    driver: str, governor: str, highest: str, limit: int | None
) -> None:
    policy = {
        "scaling_driver": driver,
        "scaling_governor": governor,
        "scaling_max_freq": highest,
        "scaling_min_freq": "600000",
        "scaling_setspeed": "700000" if governor == "userspace" else "<unsupported>",
        "cpuinfo_max_freq": "1500000",
    }
    result = slow_clock(policy)
    assert result == (None if limit is None else SlowClock(governor, limit, 1500))


def test_the_throttled_time_is_read_from_both_versions_of_cgroups(tmp_path: Path) -> None:
    assert quota("nr_throttled 3\nthrottled_usec 250000\n") == 250 * MS
    assert quota("nr_throttled 3\nthrottled_time 250000000\n") == 250 * MS
    files = QUIET | {CGROUP: "throttled_usec 70000\n"}
    assert Kernel(write(tmp_path / "2", files)).read().quota_ns == 70 * MS
    files = QUIET | {
        "proc/self/cgroup": "4:memory:/a\n3:cpu,cpuacct:/docker/1a\n",
        "sys/fs/cgroup/cpu,cpuacct/docker/1a/cpu.stat": "throttled_time 80000000\n",
    }
    assert Kernel(write(tmp_path / "1", files)).read().quota_ns == 80 * MS


def test_the_scheduling_times_of_a_thread_are_read_and_zero_if_absent() -> None:
    assert scheduled(b"682840 117991 2\n") == Scheduled(682840, 117991)
    assert scheduled(b"") == Scheduled()


def test_the_stat_of_a_program_gives_its_pid_name_time_and_priority() -> None:
    assert program(own(), TICK) == Program(812, "acsard run", 288 * TICK, 20)
    assert not program(own(), TICK).real_time
    assert program(own(priority=-21), TICK).real_time
    text = own().replace("acsard run", "a) (b")
    assert program(text, TICK).name == "a) (b"
    with pytest.raises((ValueError, IndexError)):
        program("", TICK)


def test_the_busiest_program_is_the_one_that_ran_most_between_two_readings() -> None:
    before = [Program(1, "init", 900 * MS), Program(7, "hog", 100 * MS)]
    after = [Program(1, "init", 910 * MS), Program(7, "hog", 250 * MS), Program(8, "new", 999 * MS)]
    assert busiest(before, after, 200 * MS, 20) == Program(7, "hog", 150 * MS)
    assert busiest(before, after, 900 * MS, 20) is None
    assert busiest([], [], 200 * MS, 20) is None


@pytest.mark.parametrize(
    ("thread", "program_s", "counts"),
    [(20, 20, True), (20, 39, False), (20, 25, True), (20, -21, True), (-11, 20, False),
     (-11, -11, True), (-11, -2, False), (-11, -21, True)],
)  # fmt: skip
def test_a_program_of_lower_priority_than_the_thread_is_not_blamed(
    thread: int, program_s: int, counts: bool
) -> None:
    before, after = [Program(7, "hog", 0, program_s)], [Program(7, "hog", 150 * MS, program_s)]
    assert (busiest(before, after, 200 * MS, thread) is not None) == counts
