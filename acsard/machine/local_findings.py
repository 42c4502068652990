"""What only a program on the robot's computer sees: the serial port, and the computer itself."""

from __future__ import annotations

import os
import stat
import time
from collections.abc import Iterator
from pathlib import Path

from acsard.core.codes import Code, Reason, reason
from acsard.core.config.settings import SIMULATOR
from acsard.core.values import NS_PER_S, Ns
from acsard.host import clock, real_time
from acsard.host.kernel_counters import Kernel, Reading
from acsard.host.port_access import advice_about, denial, is_orphan
from acsard.host.processes import holders, is_running
from acsard.machine import versions
from acsard.machine.finding import Finding, about, finding
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
        yield finding("brltty_running")
    if is_running("ModemManager") and not any(map(os.path.isfile, UDEV_RULES)):
        yield finding("modemmanager_running")


def unused_version() -> Iterator[Finding]:
    """Yield a finding about an installed version that the service does not run."""
    if newer := versions.unused():
        # An operator who went back perhaps left a bad version.
        went_back = newer == versions.previous()
        yield finding(
            "version_previous" if went_back else "version_unused",
            newer=newer,
            current=versions.current(),
            path=versions.HOME / newer,
        )


def clock_year() -> Iterator[Finding]:
    """Yield a finding on whether the wall clock, which stamps all messages, is plausible."""
    year = time.gmtime(clock.now().wall_ns / NS_PER_S).tm_year
    # A computer without a battery for its clock starts with an old date.
    yield finding("clock_wrong" if year < 2026 else "clock_right", year=year)


def scheduling(wanted: bool, pid: int | None) -> Iterator[Finding]:
    """Yield a finding on real-time scheduling of the daemon, or of one that this user starts.

    `wanted` is `control.real_time`.
    """
    has = None if pid is None else real_time.is_real_time(pid)
    code: Code = "real_time_unwanted"
    if wanted and has is not None:
        code = "real_time_used" if has else "real_time_missing"
    elif wanted:
        code = "real_time_allowed" if real_time.allowed() else "real_time_refused"
    yield finding(code, pid=pid)


MEASUREMENT_S = 0.3  # between two readings of the kernel's counters: 30 clock ticks


# Share of the time in which the host of a virtual machine took the processor.
MAX_STEAL_FRACTION = 0.02


def slowness(kernel: Kernel | None = None) -> Iterator[Finding]:
    """Yield findings about what slows programs down now, such as an overheated processor."""
    kernel = kernel or Kernel()
    before, began_ns = kernel.read(), clock.mono_ns()
    time.sleep(MEASUREMENT_S)
    causes = slowdowns(before, kernel.read(), clock.mono_ns() - began_ns)
    for cause in causes or [reason("computer_well")]:
        yield about("computer", cause)


def slowdowns(before: Reading, after: Reading, within_ns: Ns) -> list[Reason]:
    """Return the causes that slow down every program now."""
    causes, now = [], after.conditions
    if now.undervoltage:
        causes.append(reason("computer_undervoltage"))
    if now.slowed_by_heat or now.throttled > before.conditions.throttled:
        causes.append(reason("computer_hot"))
    if (limit := now.slow_clock) is not None:
        causes.append(
            reason(
                "computer_governor",
                governor=limit.governor,
                limit=limit.limit_mhz,
                full=limit.full_mhz,
            )
        )
    pairs = zip(before.steal_ns, after.steal_ns, strict=False)
    stolen_ns = max((new - old for old, new in pairs), default=0)
    if stolen_ns > MAX_STEAL_FRACTION * within_ns:
        causes.append(reason("computer_steal", seconds=stolen_ns / NS_PER_S))
    return causes


def serial_port(path: str, simulated: bool) -> Iterator[Finding]:
    """Yield findings about `mcu.port`: whether it exists, who may open and uses it, its USB.

    `simulated` is true if a daemon that does not run yet would simulate its robot.
    """
    if simulated:
        yield finding("port_simulated")
    if path == SIMULATOR:
        return
    if not os.path.exists(path):
        ports = ", ".join(port.device for port in serial_devices()) or "none"
        yield finding("port_missing", path=path, ports=ports)
        return
    if not stat.S_ISCHR(os.stat(path).st_mode):
        yield finding("port_not_serial", path=path)
        return
    if is_orphan(path):
        yield finding("port_orphan", path=path)
        return
    if os.access(path, os.R_OK | os.W_OK):
        yield finding("port_open", path=path)
    else:
        why, advice = denial(path)
        yield finding("port_denied", why=why, advice=advice)
    for holder in holders(path):
        # The other end of a pty is a simulator of the board, which may hold this end open, too.
        advice = advice_about(path, holder)
        code: Code = "port_held_by_acsard" if holder.name == "acsard" else "port_held"
        yield finding(
            code if advice else "port_held_by_simulator",
            path=path,
            holder=f"{holder.name} (pid {holder.pid})",
            advice=advice,
        )
    yield from _hardware(Path(os.path.realpath(path)).name)


def _hardware(name: str) -> Iterator[Finding]:
    for port in serial_devices():
        if port.device == f"/dev/{name}" and port.usb_id and not port.board:
            yield finding("port_unknown_board", usb=port.usb_id, known=", ".join(sorted(BOARDS)))
    timer = Path(f"/sys/class/tty/{name}/device/latency_timer")
    if timer.is_file() and timer.read_text().strip() != "1":
        yield finding("port_slow", timer=timer.read_text().strip(), file=timer)
