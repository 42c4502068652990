"""What only a program on the robot's computer sees: the serial port, and the computer itself."""

from __future__ import annotations

import os
import stat
import time
from collections.abc import Iterator
from pathlib import Path

from acsard.core.config.settings import SIMULATOR
from acsard.core.messages.diagnostics import SIMULATOR_ADVICE
from acsard.core.values import NS_PER_S, Ns
from acsard.host import clock, real_time
from acsard.host.kernel_counters import Kernel, Reading
from acsard.host.port_access import WITHOUT_DEVICE, advice_about, denial, is_orphan
from acsard.host.processes import holders, is_running
from acsard.machine import versions
from acsard.machine.finding import Finding, Level
from acsard.machine.serial_ports import BOARDS, serial_devices

# Of `service install`, and of the Debian package.
UDEV_RULES = ("/etc/udev/rules.d/70-acsar.rules", "/usr/lib/udev/rules.d/70-acsar.rules")


def computer(real_time: bool, pid: int | None) -> Iterator[Finding]:
    """Yield findings about this computer, with the daemon's process id `pid` if it runs.

    `real_time` is `control.real_time`.
    """
    yield from port_grabbers()
    yield from unused_version()
    yield from clock_year()
    yield from scheduling(real_time, pid)
    yield from slowness()


def port_grabbers() -> Iterator[Finding]:
    """Yield findings about programs that take over serial ports or send data to them."""
    if is_running("brltty"):
        mend = (
            "run `sudo apt remove brltty`, unless you use a Braille display: brltty takes the "
            "serial ports of CH340 and FTDI chips"
        )
        yield Finding("brltty", "failure", "the program brltty is running", mend)
    if is_running("ModemManager") and not any(map(os.path.isfile, UDEV_RULES)):
        mend = "install deploy/udev/70-acsar.rules (`acsard service install` does that)"
        yield Finding(
            "ModemManager",
            "warning",
            "ModemManager is running; this program sends data to each new serial port",
            mend,
        )


def unused_version() -> Iterator[Finding]:
    """Yield a finding about an installed version that the service does not run."""
    if newer := versions.unused():
        text = f"{newer} is installed, but not in use; the service runs {versions.current()}"
        if newer == versions.previous():  # somebody went back, perhaps from a bad version
            yield Finding("version", "ok", f"{text}, after {newer} was in use")
            return
        mend = f"`sudo acsard service upgrade {versions.HOME / newer}` changes to it"
        yield Finding("version", "warning", text, mend)


def clock_year() -> Iterator[Finding]:
    """Yield a finding on whether the wall clock, which stamps all messages, is plausible."""
    year = time.gmtime(clock.now().wall_ns / NS_PER_S).tm_year
    if year < 2026:  # a computer without a battery for its clock starts with an old date
        mend = (
            "set this computer's clock (timedatectl), or run chrony: the time stamps of the "
            "odometry come from this clock"
        )
        yield Finding("clock", "warning", f"this computer's clock shows the year {year}", mend)
    else:
        yield Finding("clock", "ok", f"this computer's clock shows the year {year}")


def scheduling(wanted: bool, pid: int | None) -> Iterator[Finding]:
    """Yield a finding on real-time scheduling of the daemon, or of one that this user starts.

    `wanted` is `control.real_time`.
    """
    has = None if pid is None else real_time.is_real_time(pid)
    level: Level = "ok"
    if not wanted:
        text = "the configuration does not request real-time scheduling (control.real_time = false)"
    elif has:
        text = f"the running daemon (pid {pid}) has real-time scheduling"
    elif has is False:
        level = "warning"
        text = f"the running daemon (pid {pid}) does not have real-time scheduling"
    elif real_time.allowed():
        text = "a daemon that this user starts gets real-time scheduling"
    else:
        level = "warning"
        text = "a daemon that this user starts does not get real-time scheduling"
    mend = (
        "run the daemon as the systemd service (deploy/systemd), which has real-time priority; "
        "without this priority, other programs on a busy computer make the daemon late"
    )
    yield Finding("real time", level, text, "" if level == "ok" else mend)


MEASUREMENT_S = 0.3  # between two readings of the kernel's counters: 30 clock ticks


# Share of the time in which the host of a virtual machine took the processor.
MAX_STEAL_FRACTION = 0.02


def slowness(kernel: Kernel | None = None) -> Iterator[Finding]:
    """Yield findings about what slows programs down now, such as an overheated processor."""
    kernel = kernel or Kernel()
    before, began_ns = kernel.read(), clock.mono_ns()
    time.sleep(MEASUREMENT_S)
    causes = slowdowns(before, kernel.read(), clock.mono_ns() - began_ns)
    for text, advice in causes:
        yield Finding("computer", "warning", f"{text}, so the daemon can be late", advice)
    if not causes:
        text = (
            "the kernel reports no undervoltage, no overheating, no slowed processor clock and no "
            "high steal time"
        )
        yield Finding("computer", "ok", text)


def slowdowns(before: Reading, after: Reading, within_ns: Ns) -> list[tuple[str, str]]:
    """Return the causes that slow down every program now, each with advice."""
    causes, now = [], after.conditions
    if now.undervoltage:
        text = "the supply voltage is too low, which slows the processor"
        causes.append((text, "use a stronger power supply and a shorter cable"))
    if now.slowed_by_heat or now.throttled > before.conditions.throttled:
        causes.append(("the processor is too hot and runs slower", "cool the processor"))
    if (limit := now.slow_clock) is not None:
        text = (
            f"the CPU governor {limit.governor} keeps the processor at {limit.limit_mhz} of "
            f"{limit.full_mhz} MHz"
        )
        causes.append((text, "choose the CPU governor schedutil or performance"))
    pairs = zip(before.steal_ns, after.steal_ns, strict=False)
    stolen_ns = max((new - old for old, new in pairs), default=0)
    if stolen_ns > MAX_STEAL_FRACTION * within_ns:
        text = f"the host gave this virtual machine no processor for {stolen_ns / NS_PER_S:.2f} s"
        causes.append((text, "give the virtual machine a processor of its own"))
    return causes


def serial_port(path: str, simulated: bool) -> Iterator[Finding]:
    """Yield findings about `mcu.port`: whether it exists, who may open and uses it, its USB.

    `simulated` is true if a daemon that does not run yet would simulate its robot.
    """
    if simulated:
        text = "mcu.port selects the built-in simulator: no robot will move"
        yield Finding("port", "warning", text, SIMULATOR_ADVICE)
    if path == SIMULATOR:
        return
    if not os.path.exists(path):
        ports = ", ".join(port.device for port in serial_devices()) or "none"
        mend = (
            "plug the board in. The board's name in /dev/serial/by-id stays the same when you plug "
            "the board in again: it is the best value of mcu.port (`acsard ports` lists the names)"
        )
        yield Finding("port", "failure", f"{path} does not exist; the ports are: {ports}", mend)
        return
    if not stat.S_ISCHR(os.stat(path).st_mode):
        mend = "`acsard ports` lists the serial devices: write one of them as mcu.port"
        yield Finding("port", "failure", f"{path} is not a serial device", mend)
        return
    if is_orphan(path):
        mend = "`acsard ports` lists the serial devices"
        yield Finding("port", "failure", f"{path} {WITHOUT_DEVICE}", mend)
        return
    yield _permission(path)
    for holder in holders(path):
        text = f"{path} is in use by {holder.name} (pid {holder.pid})"
        # The other end of a pty is a simulator of the board, which may hold this end open, too.
        mend = advice_about(path, holder)
        if not mend:
            yield Finding("port", "ok", f"{text}, which simulates the board")
        elif holder.name == "acsard":
            yield Finding("port", "ok", text)
        else:
            yield Finding("port", "failure", text, mend)
    yield from _hardware(Path(os.path.realpath(path)).name)


def _hardware(name: str) -> Iterator[Finding]:
    usb = [port for port in serial_devices() if port.device == f"/dev/{name}"]
    if usb and usb[0].usb_id and not usb[0].board:
        known = ", ".join(sorted(BOARDS))
        text = f"the port's USB id {usb[0].usb_id} is not that of a common board ({known})"
        yield Finding(
            "port",
            "warning",
            text,
            "if this is your microcontroller, add its USB id to deploy/udev/70-acsar.rules, and "
            "copy that file to /etc/udev/rules.d",
        )
    timer = Path(f"/sys/class/tty/{name}/device/latency_timer")
    if timer.is_file() and timer.read_text().strip() != "1":
        text = f"the FTDI chip of the port delays bytes by {timer.read_text().strip()} ms"
        yield Finding(
            "port",
            "warning",
            text,
            f"install deploy/udev/70-acsar.rules, or run as root: echo 1 > {timer}",
        )


def _permission(path: str) -> Finding:
    if os.access(path, os.R_OK | os.W_OK):
        return Finding("port", "ok", f"{path} is readable and writable")
    return Finding("port", "failure", *denial(path))
