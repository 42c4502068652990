"""Runs one benchmark, computes the figures from its record, and prints them with the machine.

The measured daemon has the user's configuration with some changes, in a file of its own.
"""

from __future__ import annotations

import os
import platform
import socket
import threading
from pathlib import Path
from tempfile import TemporaryDirectory

from msgspec import Struct
from msgspec.structs import replace

from acsard import __version__
from acsard.bench.matching import (
    Summary,
    command_waits,
    feedback_fates,
    lines_of,
    staircase,
    summary,
)
from acsard.bench.rig import Rig, resident_mb
from acsard.config.parsing import effective
from acsard.config.settings import (
    BusConfig,
    CommandsConfig,
    Config,
    DriveConfig,
    FeedbackConfig,
    LimitsConfig,
    LogConfig,
    RatesConfig,
    RobotConfig,
    SimConfig,
    Source,
)
from acsard.config.writing import document
from acsard.host.errors import Exit, ExitError
from acsard.messages.schema import RobotState

POINTS = {
    "command_to_wire": "command put here -> first byte of its line at the port's far end",
    "feedback_to_odometry": "feedback line's last byte handed over -> its odometry here",
    "read_to_odometry": "feedback sampled by the microcontroller (its stamp) -> its odometry here",
}
"""The figures measured from outside, and their points; "here" is the benchmark's own process."""

OWN = {
    "period_lateness": "period due (of several missed, the first) -> its step",
    "step_time": "start of a step -> its work done",
    "command_age": "command arrived -> each line that follows it",
    "command_to_wire": "command arrived in its source's turn -> first line after it",
    "feedback_to_bus": "feedback line read -> its last message handed to the bus",
    "mcu_round_trip": "line -> end of its answer (on a checked link)",
}
"""The figures that the daemon measures within its own process, as `latencies.Name` defines them."""


class Machine(Struct, frozen=True):
    """The machine on which the figures were measured."""

    cpu: str
    cores: int
    kernel: str
    python: str
    acsard: str
    realtime_permitted: bool
    """True if this user may use real-time scheduling."""


class Result(Struct, frozen=True, omit_defaults=False):
    """All figures of one run; durations are in us unless the name says otherwise."""

    machine: Machine
    port: str
    simulated: bool
    rate_hz: float
    baud_rate: int
    seconds: float
    realtime: bool
    """True if the daemon's control task had real-time scheduling."""
    outside: dict[str, Summary | None]
    """Figures by the names of `POINTS`; null for those that could not be measured."""
    own: dict[str, Summary]
    """Figures by the names of `OWN`; their percentiles are accurate to 12 %."""
    commands_sent: int
    commands_seen: int | None
    """Number of commands whose line was seen on the wire; null on a real port."""
    lines_said: int | None
    """Number of feedback lines handed over; null on a real port."""
    lines_told: int
    """Number of feedback lines that became odometry here."""
    lines_waiting_max: int | None
    """Largest number of newer lines handed over by the time of a sample; null on a real port."""
    lines_sent: int
    """Lines that the daemon handed to the port, counted up to the same moment as
    `missed_periods`.
    """
    missed_periods: int
    cpu_percent_following: float
    """Share of one core with one subscriber to the odometry and without commands."""
    cpu_percent_commanded: float
    """Share of one core with one subscriber to the odometry and 25 commands a second."""
    resident_mb: float
    start_up_ms: float | None
    """Time from the start of the process to its first line on the port; null on a real port."""


def this_machine() -> Machine:
    """Return the description of this machine."""
    return Machine(
        cpu=_cpu_model(),
        cores=len(os.sched_getaffinity(0)),
        kernel=platform.release(),
        python=platform.python_version(),
        acsard=__version__,
        realtime_permitted=_realtime_permitted(),
    )


def _cpu_model() -> str:
    """Return the processor's name from the kernel, or a board's name from the device tree."""
    try:
        board = Path("/proc/device-tree/model").read_text().strip("\0\n ")
        if board:
            return board
    except OSError:
        pass
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        name, _, value = line.partition(":")
        if name.strip() == "model name":
            return value.strip()
    return platform.machine()


def _realtime_permitted() -> bool:
    permitted = []

    # A thread asks, because a granted priority ends with it.
    def ask() -> None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
            permitted.append(True)
        except OSError:
            pass

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    return bool(permitted)


def table(result: Result) -> str:
    """Return the figures as text for people."""
    head, width = "  count      p50      p99      max  us", max(map(len, POINTS.values()))
    lines = [*_about(result), "", f"{'measured from outside':{width}}{head}"]
    for name, points in POINTS.items():
        lines.append(f"{points:{width}}{_cells(result.outside.get(name))}")
    lines += ["", f"{'measured by the daemon itself':{width}}{head}"]
    for name, points in OWN.items():
        lines.append(f"{points:{width}}{_cells(result.own.get(name))}")
    return "\n".join([*lines, "", *_counts(result)])


def _cells(summary: Summary | None) -> str:
    if summary is None or not summary.count:
        return "  not measured"
    s = summary
    return f"{s.count:7d}{s.p50:9.0f}{s.p99:9.0f}{s.max:9.0f}"


def _about(result: Result) -> list[str]:
    m = result.machine
    permitted = "permitted" if m.realtime_permitted else "not permitted"
    used = "used by the daemon" if result.realtime else "not used by the daemon"
    port = "simulated microcontroller, plain lines"
    if not result.simulated:
        port = f"{result.port}, zero speeds only"
    return [
        f"machine   {m.cpu}, {m.cores} cores, Linux {m.kernel}, Python {m.python}",
        f"          real-time scheduling {permitted}, {used}",
        f"run       acsard {m.acsard}, {port}, {result.rate_hz:g} Hz at {result.baud_rate} baud, "
        f"{result.seconds:g} s",
    ]


def _counts(result: Result) -> list[str]:
    r = result
    seen = "" if r.commands_seen is None else f", {r.commands_seen} seen on the wire"
    said = "" if r.lines_said is None else f" of {r.lines_said}"
    waiting = ""
    if r.lines_waiting_max is not None:
        waiting = f", at most {r.lines_waiting_max} newer waiting"
    start = "not measured" if r.start_up_ms is None else f"{r.start_up_ms:.0f} ms"
    rows = [
        ("commands", f"{r.commands_sent} sent{seen}"),
        ("feedback lines", f"{r.lines_told}{said} became odometry here{waiting}"),
        ("periods missed", f"{r.missed_periods}, beside {r.lines_sent} lines sent"),
        ("processor", f"{r.cpu_percent_following:.1f} % of a core with one subscriber"),
        ("", f"{r.cpu_percent_commanded:.1f} % with 25 commands a second as well"),
        ("memory", f"{r.resident_mb:.0f} MB resident"),
        ("start-up", f"{start} from the start of the process to the first line on the port"),
    ]
    lines = [f"{name:16}{text}" for name, text in rows]
    if not r.simulated:
        lines.append(f"{'left out':16}the wire of a real port cannot be seen from here")
    return lines


def bench_config(config: Config, *, simulated: bool) -> Config:
    """Return the configuration to measure with: it has its own robot id, bus and source.

    With the simulator, a command must reach the next line unchanged, and feedback that does not
    match it must not be a fault. Lines are plain there, because the sequence number of a checked
    line would hide the speed by which it is recognized.
    """
    own = replace(
        config,
        robot=RobotConfig(f"bench-{os.getpid()}"),
        bus=BusConfig(listen=(free_endpoint(),)),
        commands=CommandsConfig(sources=(Source("bench", 100),)),
        rates=RatesConfig(),
        log=LogConfig(),
        control=replace(config.control, state_directory=""),
    )
    if not simulated:
        return own
    return replace(
        own,
        mcu=replace(own.mcu, link_check="off", encoder_counts=0),
        control=replace(own.control, auto_activate=True),
        drive=DriveConfig(),
        feedback=FeedbackConfig(fault_time=0.0),
        limits=LimitsConfig(
            linear_acceleration=100.0,
            linear_deceleration=100.0,
            linear_stop_deceleration=100.0,
            angular_acceleration=500.0,
            angular_deceleration=500.0,
            angular_stop_deceleration=500.0,
        ),
        sim=SimConfig(),
    )


def free_endpoint() -> str:
    """Return a loopback address on which no process listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def write(config: Config, where: Path) -> Path:
    """Write the configuration to a file in the directory `where`."""
    file = where / "acsard.toml"
    file.write_text("\n".join(document(effective(config))) + "\n", encoding="utf-8")
    return file


def measure(config: Config, port: str, seconds: float) -> Result:
    """Measure for `seconds`: a quarter without commands, the rest with commands.

    With an empty `port` the simulated board is measured.
    """
    with TemporaryDirectory(prefix="acsard-bench-") as where:
        file = write(config, Path(where))
        with Rig(config, file, port=port) as rig:
            followed = rig.follow(seconds / 4)
            commanded = rig.command(seconds * 3 / 4, (lambda _: 0.0) if port else staircase)
            return _result(config, port, seconds, rig, (followed, commanded))


def _own(state: RobotState) -> dict[str, Summary]:
    spreads = {name: figure.since_start for name, figure in state.figures.items()}
    return {
        name: Summary(s.count, round(s.p50, 1), round(s.p99, 1), round(s.max, 1))
        for name, s in spreads.items()
    }


def _nothing_seen(sent: int, state: RobotState) -> ExitError:
    return ExitError(
        Exit.FAILURE,
        f"none of the {sent} commands came out on the wire, so nothing was measured; the daemon "
        f"says: {state.reason}",
    )


def _result(
    config: Config, port: str, seconds: float, rig: Rig, shares: tuple[float, float]
) -> Result:
    state, pid = rig.state(), rig.process.pid
    policy = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK
    realtime = policy in (os.SCHED_FIFO, os.SCHED_RR)
    resident = resident_mb(pid)
    record = rig.end()
    read = [sample.at.wall_ns - sample.stamp_ns for sample in record.samples]
    outside = {"read_to_odometry": summary(read)}
    seen = lines_said = lines_waiting = start_up = None
    lines_told = len(record.samples)
    if record.seen is not None:
        heard = lines_of(record.seen.heard)
        waits, fed = command_waits(record), feedback_fates(config, record)
        outside["command_to_wire"] = summary(waits)
        outside["feedback_to_odometry"] = summary([one.delay_ns for one in fed])
        seen, lines_said, lines_told = len(waits), len(record.said), len(fed)
        if record.sent and not seen:
            raise _nothing_seen(len(record.sent), state)
        lines_waiting = max((one.waiting for one in fed), default=0)
        start_up = round((heard[0][0] - record.began_ns) / 1e6, 1)
    return Result(
        machine=this_machine(),
        port=port or "simulator",
        simulated=not port,
        rate_hz=config.rate_hz,
        baud_rate=config.mcu.baud_rate,
        seconds=seconds,
        realtime=realtime,
        outside=outside,
        own=_own(state),
        commands_sent=len(record.sent),
        commands_seen=seen,
        lines_said=lines_said,
        lines_told=lines_told,
        lines_waiting_max=lines_waiting,
        lines_sent=state.counters.get("lines_sent", 0),
        missed_periods=state.counters.get("missed_periods", 0),
        cpu_percent_following=round(100 * shares[0], 2),
        cpu_percent_commanded=round(100 * shares[1], 2),
        resident_mb=round(resident, 1),
        start_up_ms=start_up,
    )
