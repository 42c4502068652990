"""The codes of the computer on which the daemon runs."""

from __future__ import annotations

from typing import Literal

from acsard.core.tables.finding_table import table

ComputerCode = Literal[
    "brltty_running", "modemmanager_running", "version_previous", "version_unused", "clock_wrong",
    "clock_right", "clock_apart", "real_time_unwanted", "real_time_used", "real_time_allowed",
    "real_time_missing", "real_time_refused", "computer_undervoltage", "computer_hot",
    "computer_governor", "computer_steal", "computer_well",
]  # fmt: skip

COMPUTER = table(
    ComputerCode,
    """
FAIL brltty: running
    the program brltty is running
    -> run `sudo apt remove brltty`, unless you use a Braille display: brltty takes the serial ports
    of CH340 and FTDI chips
WARN ModemManager: running
    ModemManager is running; this program sends data to each new serial port
    -> install deploy/udev/70-acsar.rules (`acsard service install` does that)
OK version: previous
    {newer} is installed, but not in use; the service runs {current}, after {newer} was in use
WARN version: unused
    {newer} is installed, but not in use; the service runs {current}
    -> `sudo acsard service upgrade {path}` changes to it
OK clock: right
    this computer's clock shows the year {year}
WARN clock: wrong
    this computer's clock shows the year {year}
    -> set this computer's clock (timedatectl), or run chrony: the time stamps of the odometry come
    from this clock
WARN clock: apart
    the daemon's clock is {seconds:.1f} s {way} this machine's
    -> let NTP set the clocks of both machines (timedatectl), or let the clients echo the key beat
    (page explanation/commands of the manual): commands with an echo do not need a common clock
OK real time: unwanted
    the configuration does not request real-time scheduling (control.real_time = false)
OK real time: used
    the running daemon (pid {pid}) has real-time scheduling
OK real time: allowed
    a daemon that this user starts gets real-time scheduling
WARN real time: missing
    the running daemon (pid {pid}) does not have real-time scheduling
    -> run the daemon as the systemd service (deploy/systemd), which has real-time priority; without
    this priority, other programs on a busy computer make the daemon late
WARN real time: refused
    a daemon that this user starts does not get real-time scheduling
    -> run the daemon as the systemd service (deploy/systemd), which has real-time priority; without
    this priority, other programs on a busy computer make the daemon late
WARN computer: undervoltage
    the supply voltage is too low, which slows the processor, so the daemon can be late
    -> use a stronger power supply and a shorter cable
WARN computer: hot
    the processor is too hot and runs slower, so the daemon can be late
    -> cool the processor
WARN computer: governor
    the CPU governor {governor} keeps the processor at {limit} of {full} MHz, so the daemon can be
    late
    -> choose the CPU governor schedutil or performance
WARN computer: steal
    the host gave this virtual machine no processor for {seconds:.2f} s, so the daemon can be late
    -> give the virtual machine a processor of its own
OK computer: well
    the kernel reports no undervoltage, no overheating, no slowed processor clock and no high steal
    time
""",
)
