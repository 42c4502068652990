"""Files of the kernel as text, for tests of the causes of lateness.

The files of `QUIET` below /proc and of the cgroup were recorded on a virtual machine. The files of
the Raspberry Pi, of the processor's clock and of the cooling devices do not exist on that machine.
They have the form of the kernel's documentation (hwmon, cpufreq, thermal sysfs).
"""

from __future__ import annotations

import os
from pathlib import Path

STAT = """\
cpu  9379787 3910699 1380949 2549540 24711 0 49079 {steal} 0 0
cpu0 4563760 1967646 673613 1415998 7026 0 17675 {steal} 0 0
cpu1 4816027 1943052 707336 1133541 {iowait} 0 31403 19567 0 0
intr 1215464218 0 9 0 0 0 0 0 0 0
ctxt 2284722471
btime 1795365302
"""

OWN = (
    "{pid} (acsard run) R 12987 12987 12022 0 -1 4194304 101 0 {faults} 0 231 57 0 0 {priority} "
    "0 1 0 8686208 3133440 412 18446744073709551615 93882081382400 93882081402281 140736274310272 "
    "0 0 0 0 0 0 0 0 0 17 0 0 0 {blocked} 0 0 93882081418288 93882081419904 93882555944960 "
    "140736274311875 140736274311895 140736274311895 140736274313195 0\n"
)

IO = """\
rchar: 6976
wchar: 0
syscr: 10
syscw: 0
read_bytes: {read}
write_bytes: 4096
cancelled_write_bytes: 0
"""

PRESSURE = """\
some avg10=0.00 avg60=0.10 avg300=0.29 total={some}
full avg10=0.00 avg60=0.03 avg300=0.19 total=174048332
"""

HWMON = "sys/class/hwmon/hwmon1/"
FIRMWARE = "sys/devices/platform/soc/soc:firmware/get_throttled"
COOLER = "sys/class/thermal/cooling_device0/"
COUNT = "sys/devices/system/cpu/cpu0/thermal_throttle/core_throttle_count"
POLICY = "sys/devices/system/cpu/cpufreq/policy0/"
CGROUP = "sys/fs/cgroup/system.slice/acsard.service/cpu.stat"
OWN_STAT = "proc/self/stat"
OWN_IO = f"proc/self/task/{os.getpid()}/io"


def stat(steal: int = 18419, iowait: int = 17685) -> str:
    """Return `/proc/stat`; the times are in ticks of 10 ms."""
    return STAT.format(steal=steal, iowait=iowait)


def own(faults: int = 3, blocked: int = 0, pid: int = 812, priority: int = 20) -> str:
    """Return `/proc/PID/stat` with these major faults and ticks of waiting for a disk."""
    return OWN.format(faults=faults, blocked=blocked, pid=pid, priority=priority)


QUIET = {
    "proc/stat": stat(),
    OWN_STAT: own(),
    OWN_IO: IO.format(read=8192),
    "proc/pressure/io": PRESSURE.format(some=715587067),
    "proc/self/cgroup": "0::/system.slice/acsard.service\n",
    CGROUP: "usage_usec 231000\nnr_periods 9\nnr_throttled 0\nthrottled_usec 0\n",
    HWMON + "name": "rpi_volt\n",
    HWMON + "in0_lcrit_alarm": "0\n",
    "sys/class/hwmon/hwmon0/name": "cpu_thermal\n",
    FIRMWARE: "0\n",
    COOLER + "type": "cpufreq-cpu0\n",
    COOLER + "cur_state": "0\n",
    "sys/class/thermal/cooling_device1/type": "Fan\n",
    "sys/class/thermal/cooling_device1/cur_state": "3\n",
    COUNT: "2\n",
    POLICY + "scaling_driver": "cpufreq-dt\n",
    POLICY + "scaling_governor": "ondemand\n",
    POLICY + "scaling_max_freq": "1500000\n",
    POLICY + "scaling_min_freq": "600000\n",
    POLICY + "scaling_setspeed": "<unsupported>\n",
    POLICY + "cpuinfo_max_freq": "1500000\n",
}
"""A Raspberry Pi on which nothing makes a program late."""


def write(root: Path, files: dict[str, str]) -> Path:
    """Write the files below `root`, and return it."""
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root
