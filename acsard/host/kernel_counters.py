"""Reads counters of the Linux kernel that show why this computer is slow now.

The counters show undervoltage, heat, clock limits and steal time. A counter reads as 0, and a
condition as absent, if this kernel does not have the counter's file, or if this user may not read
it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from msgspec import Struct

from acsard.core.values import NS_PER_S

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
    """The steal time of each processor, and the conditions of the processors, at one moment."""

    steal_ns: tuple[int, ...] = ()
    """For each processor, the total time in which the host of this virtual machine ran other work,
    ns."""
    conditions: Conditions = Conditions()


def steal(text: str, tick_ns: int) -> tuple[int, ...]:
    """Return the steal time of each processor, ns.

    In this time, the host of this virtual machine ran other work on the processor. `text` is the
    content of `/proc/stat`, which counts clock ticks. `tick_ns` is the duration of a clock tick,
    ns.
    """
    rows = [line.split() for line in text.splitlines() if line.startswith("cpu")]
    # The row "cpu" is the sum of all processors.
    return tuple(int(row[8]) * tick_ns for row in rows if row[0] != "cpu" and len(row) > 8)


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
    """Reader of the kernel's counters."""

    def __init__(self, root: Path = Path("/")) -> None:
        """Find the kernel's files below the directory `root`. Only tests pass another `root`."""
        self._stat = root / "proc/stat"
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

    def read(self) -> Reading:
        return Reading(steal(_text(self._stat), self._tick_ns), self._conditions())

    def _conditions(self) -> Conditions:
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
    try:
        return path.read_text(errors="replace")
    except OSError:
        return ""
