"""Files of the kernel as text, for tests of the causes of lateness.

`/proc/stat` was recorded on a virtual machine. The files of
the Raspberry Pi, of the processor's clock and of the cooling devices do not exist on that machine.
They have the form of the kernel's documentation (hwmon, cpufreq, thermal sysfs).
"""

from __future__ import annotations

from pathlib import Path

STAT = """\
cpu  9379787 3910699 1380949 2549540 24711 0 49079 18419 0 0
cpu0 4563760 1967646 673613 1415998 7026 0 17675 18419 0 0
cpu1 4816027 1943052 707336 1133541 17685 0 31403 19567 0 0
intr 1215464218 0 9 0 0 0 0 0 0 0
ctxt 2284722471
btime 1795365302
"""

HWMON = "sys/class/hwmon/hwmon1/"
FIRMWARE = "sys/devices/platform/soc/soc:firmware/get_throttled"
COOLER = "sys/class/thermal/cooling_device0/"
COUNT = "sys/devices/system/cpu/cpu0/thermal_throttle/core_throttle_count"
POLICY = "sys/devices/system/cpu/cpufreq/policy0/"

QUIET = {
    "proc/stat": STAT,
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
