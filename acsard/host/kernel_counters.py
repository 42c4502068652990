"""Reads the kernel's counters that can explain why a program was late.

A counter is 0 if this computer does not have the counter's file, or if this user may not read it. A
reading can take a few milliseconds, so the control loop never reads the counters.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.values import NS_PER_S
from acsard.host import clock

SELF_SCALING_DRIVERS = ("intel_pstate", "amd-pstate", "amd-pstate-epp")
"""The cpufreq drivers whose governor `powersave` adapts the frequency to the load. With every other
driver, the governor `powersave` keeps the lowest frequency."""

COOLING_TYPES = ("Processor", "cpufreq", "thermal-cpufreq", "thermal-idle", "intel_powerclamp")
"""Beginnings of the types (in sysfs) of those cooling devices that slow a processor down."""


class SlowClock(Struct, frozen=True):
    """A limit that keeps the processor below its full clock frequency."""

    governor: str
    limit_mhz: int
    full_mhz: int


class Conditions(Struct, frozen=True, omit_defaults=True):
    """Present conditions that slow the processors down: low voltage, heat or a clock limit."""

    undervoltage: bool = False
    slowed_by_heat: bool = False
    """Whether a cooling device or the firmware slows the processor down now."""
    throttled: int = 0
    """Total number of times that the processors have slowed down because of heat."""
    slow_clock: SlowClock | None = None


class Reading(Struct, frozen=True, omit_defaults=True):
    """The kernel's counters at one moment.

    Each counter is a total. The difference between two readings shows the activity in between.
    """

    asleep_ns: int = 0
    steal_ns: tuple[int, ...] = ()
    """For each processor, the time in which the host of this virtual machine ran other work, ns."""
    disk_ns: int = 0
    """Time in which at least one program waited for a disk, ns."""
    own_disk_ns: int = 0
    """Time in which the first thread of this process waited for a disk, ns. Most kernels measure it
    only if the setting `kernel.task_delayacct` is on."""
    own_bytes: int = 0
    """Number of bytes that the first thread of this process read from disks and wrote to them."""
    major_faults: int = 0
    """Number of memory pages that this process had to read from a disk before it could continue."""
    quota_ns: int = 0
    """Time in which this process did not run because its cgroup had used up its CPU quota, ns."""
    conditions: Conditions = Conditions()


class Scheduled(Struct, frozen=True, omit_defaults=True):
    """The time for which a thread ran, and the time for which it waited for a processor.

    Both are totals since the start of the thread, ns. A thread waits if it is ready to run, but no
    processor runs it.
    """

    ran_ns: int = 0
    waited_ns: int = 0


class Program(Struct, frozen=True):
    """A process. `ran_ns` is the processor time that it has used, ns."""

    pid: int
    name: str
    ran_ns: int
    priority: int = 20
    """Kernel priority of the process's first thread. A smaller number is a higher priority. It is
    20 plus the nice value for an ordinary thread, and negative for a real-time thread."""

    @property
    def real_time(self) -> bool:
        """Whether the first thread has real-time priority, above all ordinary threads."""
        return self.priority < 0


def scheduled(text: bytes) -> Scheduled:
    """Decode the text of `/proc/PID/task/TID/schedstat`. Return zeros if the text is empty."""
    words = text.split()
    return Scheduled(int(words[0]), int(words[1])) if len(words) > 1 else Scheduled()


def steal(text: str, tick_ns: int) -> tuple[int, ...]:
    """Return the steal time of each processor, ns.

    In this time, the host of this virtual machine ran other work on the processor. `text` is the
    content of `/proc/stat`, which counts clock ticks. `tick_ns` is the duration of a clock tick,
    ns.
    """
    return tuple([int(row[8]) * tick_ns for row in _processors(text) if len(row) > 8])


def iowait(text: str, tick_ns: int) -> int:
    """Return the time for which a processor was idle while a program waited for I/O, ns.

    Of all processors, return the longest such time. `text` is the content of `/proc/stat`, which
    counts clock ticks. `tick_ns` is the duration of a clock tick, ns.
    """
    return max((int(row[5]) * tick_ns for row in _processors(text)), default=0)


def _processors(text: str) -> list[list[str]]:
    rows = [line.split() for line in text.splitlines() if line.startswith("cpu")]
    # The row "cpu" is the sum of all processors.
    return [row for row in rows if row[0] != "cpu"]


def stalled(text: str) -> int:
    """Return the total time in which at least one task waited for a resource, such as a disk, ns.

    `text` is the content of the resource's pressure file, such as `/proc/pressure/io`.
    """
    for line in text.splitlines():
        if line.startswith("some "):
            return int(line.rpartition("total=")[2]) * 1000
    return 0


def quota(text: str) -> int:
    """Return the total time for which a cgroup was stopped by its CPU quota, ns.

    `text` is the content of the cgroup's file `cpu.stat` (cgroup v1 or v2).
    """
    for line in text.splitlines():
        name, _, value = line.partition(" ")
        if name == "throttled_usec":
            return int(value) * 1000
        if name == "throttled_time":
            return int(value)
    return 0


def disk_bytes(text: str) -> int:
    """Return the number of bytes that a thread has read from disks and written to disks.

    `text` is the content of `/proc/PID/task/TID/io`.
    """
    rows = (line.partition(": ") for line in text.splitlines())
    return sum(int(value) for name, _, value in rows if name in ("read_bytes", "write_bytes"))


def fields(text: str) -> list[str]:
    """Return the fields in the text of `/proc/PID/stat`, without the first two fields.

    Item 0 is therefore `state`, which is field 3 in the manual page proc(5).
    """
    return text.rpartition(")")[2].split()


def program(text: str, tick_ns: int) -> Program:
    """Decode the text of `/proc/PID/stat`. `tick_ns` is the duration of a clock tick, ns.

    Raises `ValueError` or `IndexError` if the text has another form, for example because it is
    empty.
    """
    rest = fields(text)
    before = text.rpartition(")")[0]
    pid, _, name = before.partition(" (")
    ran = (int(rest[11]) + int(rest[12])) * tick_ns
    return Program(int(pid), name, ran, int(rest[15]))


def busiest(
    before: Iterable[Program], after: Iterable[Program], within_ns: int, priority: int
) -> Program | None:
    """Return the process that used the most processor time between two readings.

    In the result, `ran_ns` is the time for which the process ran between the readings, ns. Return
    None if no process used at least a quarter of one processor.

    Args:
        before: all processes at the first reading.
        after: all processes at the second reading.
        within_ns: time between the two readings, ns.
        priority: kernel priority of a thread. Processes that cannot delay this thread are ignored.
    """
    # A process whose nice value is higher by 9 can still delay the thread noticeably. At a
    # difference of 10, the kernel gives the process only a tenth of the thread's weight.
    least = priority + 9 if priority >= 0 else priority
    ran = {(process.pid, process.name): process.ran_ns for process in before}
    grown = [
        replace(process, ran_ns=process.ran_ns - ran[process.pid, process.name])
        for process in after
        if (process.pid, process.name) in ran and process.priority <= least
    ]
    candidate = max(grown, key=lambda process: process.ran_ns, default=None)
    return candidate if candidate is not None and candidate.ran_ns * 4 >= within_ns else None


def slow_clock(policy: Mapping[str, str]) -> SlowClock | None:
    """Return the frequency limit of a processor if the limit is below 0.6 of the full frequency.

    Otherwise return None. `policy` maps the names of the files in the processor's `cpufreq`
    directory to their contents. The present frequency is not used, because an idle processor runs
    slowly anyway.
    """
    governor, limit = policy.get("scaling_governor", ""), policy.get("scaling_max_freq", "")
    if governor == "powersave" and policy.get("scaling_driver") not in SELF_SCALING_DRIVERS:
        limit = policy.get("scaling_min_freq", limit)
    if governor == "userspace":
        limit = policy.get("scaling_setspeed", limit)
    full = policy.get("cpuinfo_max_freq", "")
    if not (limit.isdigit() and full.isdigit()) or int(limit) >= 0.6 * int(full):
        return None
    return SlowClock(governor, int(limit) // 1000, int(full) // 1000)


class Kernel:
    """Reader of the kernel's counters. Do not call its methods from several threads."""

    def __init__(self, root: Path = Path("/")) -> None:
        """Find the kernel's files below the directory `root`. Only tests pass another `root`."""
        self._root, self._proc = root, root / "proc"
        # The first thread of a process has the same id as the process.
        self._io = root / f"proc/self/task/{os.getpid()}/io"
        self._stat, self._own_stat = self._proc / "stat", self._proc / "self/stat"
        self._tick_ns = NS_PER_S // os.sysconf("SC_CLK_TCK")
        cpu, hwmon = root / "sys/devices/system/cpu", root / "sys/class/hwmon"
        self._alarms = [
            chip / "in0_lcrit_alarm"
            for chip in sorted(hwmon.glob("hwmon*"))
            if _text(chip / "name").strip() == "rpi_volt"
        ]
        self._firmware = sorted(root.glob("sys/devices/platform/soc*/*firmware/get_throttled"))
        self._throttle_counts = sorted(cpu.glob("cpu*/thermal_throttle/*_throttle_count"))
        self._coolers = [
            device / "cur_state"
            for device in sorted((root / "sys/class/thermal").glob("cooling_device*"))
            if _text(device / "type").startswith(COOLING_TYPES)
        ]
        self._policies = sorted(cpu.glob("cpufreq/policy*"))
        # Without pressure stall information, these files are missing or cannot be read.
        self._pressure = next((path for path in self._pressures() if _text(path)), None)
        self._quota = next((path for path in self._cgroups() if path.is_file()), None)

    def read(self, conditions: Conditions | None = None) -> Reading:
        """Read all counters.

        The result contains `conditions`. If `conditions` is None, read the present conditions of
        the processors too.
        """
        stat = _text(self._stat)
        own = fields(_text(self._own_stat))
        pressure = "" if self._pressure is None else _text(self._pressure)
        disk_ns = stalled(pressure) if pressure else iowait(stat, self._tick_ns)
        return Reading(
            clock.asleep_ns(),
            steal(stat, self._tick_ns),
            disk_ns,
            int(own[39]) * self._tick_ns if len(own) > 39 else 0,
            disk_bytes(_text(self._io)),
            int(own[9]) if len(own) > 9 else 0,
            0 if self._quota is None else quota(_text(self._quota)),
            self.conditions() if conditions is None else conditions,
        )

    def conditions(self) -> Conditions:
        bits = 0
        for path in self._firmware:
            bits |= _number(path, 16)
        # Bit 0 of the Raspberry Pi's `get_throttled`: the supply voltage is too low now.
        low = bool(bits & 1) or any(_number(path) for path in self._alarms)
        # Bits 1 to 3: the clock frequency is limited, the processor is throttled, or the soft
        # temperature limit is active. At a low voltage the firmware also sets these bits, so they
        # do not prove heat.
        throttled = bool(bits & 0b1110) and not low
        cooled = any(_number(path) > 0 for path in self._coolers)
        slow = (slow_clock(_policy(path)) for path in self._policies)
        return Conditions(
            low,
            cooled or throttled,
            sum(map(_number, self._throttle_counts)),
            next((limit for limit in slow if limit is not None), None),
        )

    def busiest(self, seconds: float) -> Program | None:
        """Return the process that uses the most processor time during the next `seconds` s.

        This call blocks for `seconds`. It ignores this process, processes whose priority is too low
        to delay this process, and processes that the kernel hides from this user. Return None if no
        other process uses at least a quarter of a processor.
        """
        before, began_ns = list(self.programs()), clock.mono_ns()
        time.sleep(seconds)
        passed_ns = clock.mono_ns() - began_ns
        own = fields(_text(self._own_stat))
        priority = int(own[15]) if len(own) > 15 else 20
        return busiest(before, self.programs(), passed_ns, priority)

    def programs(self) -> Iterator[Program]:
        """Yield the other processes that this user can see."""
        own = str(os.getpid())
        for name in os.listdir(self._proc):
            if name.isdigit() and name != own:
                try:
                    yield program(_text(self._proc / name / "stat"), self._tick_ns)
                except (ValueError, IndexError):
                    # The process has ended.
                    continue

    def _pressures(self) -> Iterator[Path]:
        # A sandbox may hide the first file (`ProcSubset=pid` of systemd).
        yield self._proc / "pressure/io"
        yield self._root / "sys/fs/cgroup/io.pressure"

    def _cgroups(self) -> Iterator[Path]:
        """Yield the paths at which this process's cgroup may have its file `cpu.stat`."""
        mounted = self._root / "sys/fs/cgroup"
        for line in _text(self._proc / "self/cgroup").splitlines():
            controllers, path = line.split(":", 2)[1:]
            if controllers and "cpu" not in controllers.split(","):
                continue
            # A container may see its own cgroup as the root.
            yield mounted / controllers / path.strip("/") / "cpu.stat"
            yield mounted / controllers / "cpu.stat"


def _policy(directory: Path) -> dict[str, str]:
    names = (
        "scaling_driver", "scaling_governor", "scaling_max_freq", "scaling_min_freq",
        "scaling_setspeed", "cpuinfo_max_freq",
    )  # fmt: skip
    return {name: _text(directory / name).strip() for name in names}


def _number(path: Path, base: int = 10) -> int:
    try:
        return int(_text(path), base)
    except ValueError:
        return 0


def _text(path: Path) -> str:
    # A file object would take longer to make than the kernel takes to write the text.
    try:
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return ""
    try:
        return os.read(file, 16384).decode(errors="replace")
    except OSError:
        return ""
    finally:
        os.close(file)
