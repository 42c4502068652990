"""Reads counters of the Linux kernel that show why this computer is slow now.

These are undervoltage, heat, clock limits and steal time. A counter that is missing or not readable
is 0, and a condition absent.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from msgspec import Struct

from acsard.core.values import NS_PER_S, Ns

# Their governor `powersave` follows the load; others keep the lowest frequency.
SELF_SCALING_DRIVERS = ("intel_pstate", "amd-pstate", "amd-pstate-epp")

# Begins of types in sysfs that slow a processor down.
COOLING_TYPES = ("Processor", "cpufreq", "thermal-cpufreq", "thermal-idle", "intel_powerclamp")


class SlowClock(Struct, frozen=True):
    """A limit that keeps the processor below its full clock frequency."""

    governor: str
    limit_mhz: int
    full_mhz: int


class Conditions(Struct, frozen=True, omit_defaults=True):
    """Present conditions that slow the processors down."""

    undervoltage: bool = False
    slowed_by_heat: bool = False  # now, by a cooling device or the firmware
    throttled: int = 0  # total number of slowdowns by heat
    slow_clock: SlowClock | None = None


class Reading(Struct, frozen=True, omit_defaults=True):
    """The steal time and the conditions of the processors at one moment."""

    # Total time of each processor for other work of this virtual machine's host.
    steal_ns: tuple[int, ...] = ()
    conditions: Conditions = Conditions()


def steal(text: str, tick_ns: Ns) -> tuple[int, ...]:
    """Return each processor's time for other work of this virtual machine's host.

    `text` is `/proc/stat`, in ticks of `tick_ns`.
    """
    rows = [line.split() for line in text.splitlines() if line.startswith("cpu")]
    # The row "cpu" is the sum of all processors.
    return tuple(int(row[8]) * tick_ns for row in rows if row[0] != "cpu" and len(row) > 8)


def slow_clock(policy: Mapping[str, str]) -> SlowClock | None:
    """Return a frequency limit below 0.6 of the full frequency, or None.

    `policy` has the files of `cpufreq`. An idle processor is slow anyway, so the present frequency
    is no sign.
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
        # Only tests pass another `root`.
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
