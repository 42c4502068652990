"""Makes the tables that `acsard bench` prints."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator, Mapping
from pathlib import Path

from msgspec import Struct
from rich.console import RenderableType

from acsard.bench.matching import Summary
from acsard.host import real_time
from acsard.host.version import version
from acsard.terminal.output import table

POINTS = {
    "command_to_wire": "benchmark calls put() -> microcontroller gets the line's first byte",
    "feedback_to_odometry": "microcontroller sends a line's last byte -> benchmark gets odometry",
    "read_to_odometry": "microcontroller samples the wheels (stamp) -> benchmark gets odometry",
}
"""Maps each duration that the benchmark measures to the events at its start and at its end."""

OWN = {
    "period_lateness": "control step due (or first missed step due) -> step begins",
    "step_time": "control step begins -> same step ends",
    "command_age": "command arrives at the daemon -> each line that carries it",
    "command_to_wire": "command of the active source arrives -> first line that carries it",
    "feedback_to_bus": "daemon has read a feedback line -> its messages are on the bus queue",
    "mcu_round_trip": "daemon writes a line -> end of the reply (only on a checked link)",
}
"""Maps each duration that the daemon measures to the events at its start and at its end."""


class Machine(Struct, frozen=True):
    cpu: str
    cores: int
    kernel: str
    python: str
    acsard: str
    realtime_permitted: bool


class Result(Struct, frozen=True, omit_defaults=False):
    """All figures of one run. The durations are in us unless the name states another unit."""

    machine: Machine
    port: str
    simulated: bool
    rate_hz: float
    baud_rate: int
    seconds: float
    realtime: bool
    """Whether the daemon's control loop had real-time scheduling."""
    outside: dict[str, Summary | None]
    """Summaries of the durations in `POINTS`, by name. A duration that was not measured is null or
    absent."""
    own: dict[str, Summary]
    """Summaries of the durations in `OWN`, by name. The percentiles are accurate to 12 %."""
    commands_sent: int
    commands_seen: int | None
    """Number of commands whose line arrived at the simulated board; null on a real port."""
    lines_said: int | None
    """Number of feedback lines that the simulated board wrote; null on a real port."""
    lines_told: int
    """Number of feedback lines whose odometry the benchmark received."""
    lines_waiting_max: int | None
    """Largest number of newer lines that the simulated board had already written when the odometry
    of a line arrived at the benchmark; null on a real port."""
    lines_sent: int
    """Number of lines that the daemon had written to the port when the benchmark read
    `missed_periods`."""
    missed_periods: int
    cpu_percent_following: float
    """Processor use with a subscriber to the odometry and without commands, % of one core."""
    cpu_percent_commanded: float
    """Processor use with a subscriber to the odometry and 25 commands a second, % of one core."""
    resident_mb: float
    start_up_ms: float | None
    """Time from the start of the daemon to its first line on the port, ms; null on a real port."""


def this_machine() -> Machine:
    return Machine(
        cpu=_cpu_model(),
        cores=len(os.sched_getaffinity(0)),
        kernel=platform.release(),
        python=platform.python_version(),
        acsard=version(),
        realtime_permitted=real_time.allowed(),
    )


def _cpu_model() -> str:
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


def parts(result: Result) -> Iterator[RenderableType]:
    outside = _figures("measured from outside", POINTS, result.outside)
    own = _figures("measured by the daemon itself", OWN, result.own)
    yield table(_about(result))
    yield from ("", table([*outside, (), *own], right={1, 2, 3, 4}), "")
    yield table(_counts(result))


def _figures(
    head: str, points: dict[str, str], summaries: Mapping[str, Summary | None]
) -> list[tuple[str, ...]]:
    rows = [(words, *_cells(summaries.get(name))) for name, words in points.items()]
    return [(head, "count", "p50", "p99", "max us"), *rows]


def _cells(summary: Summary | None) -> tuple[str, ...]:
    if summary is None or not summary.count:
        return ("not measured",)
    return (str(summary.count), *(f"{us:.0f}" for us in (summary.p50, summary.p99, summary.max)))


def _about(result: Result) -> list[tuple[str, str]]:
    m = result.machine
    permitted = "permitted" if m.realtime_permitted else "not permitted"
    used = "used by the daemon" if result.realtime else "not used by the daemon"
    port = "simulated microcontroller, plain lines"
    if not result.simulated:
        port = f"{result.port}, zero speeds only"
    return [
        ("machine", f"{m.cpu}, {m.cores} cores, Linux {m.kernel}, Python {m.python}"),
        ("", f"real-time scheduling {permitted}, {used}"),
        (
            "run",
            f"acsard {m.acsard}, {port}, {result.rate_hz:g} Hz at {result.baud_rate} baud, "
            f"{result.seconds:g} s",
        ),
    ]


def _counts(result: Result) -> list[tuple[str, str]]:
    r = result
    wire_text = "" if r.commands_seen is None else f", {r.commands_seen} seen on the wire"
    lines_text = "" if r.lines_said is None else f" of {r.lines_said}"
    start = "not measured" if r.start_up_ms is None else f"{r.start_up_ms:.0f} ms"
    rows = [
        ("commands", f"{r.commands_sent} sent{wire_text}"),
        ("feedback lines", f"{r.lines_told}{lines_text} reached the benchmark as odometry"),
        ("periods missed", f"{r.missed_periods}; {r.lines_sent} lines were sent"),
        ("processor", f"{r.cpu_percent_following:.1f} % of a core with one subscriber"),
        ("", f"{r.cpu_percent_commanded:.1f} % with 25 commands a second as well"),
        ("memory", f"{r.resident_mb:.0f} MB resident"),
        ("start-up", f"{start} from the start of the process to the first line on the port"),
    ]
    if r.lines_waiting_max is not None:
        text = (
            f"when odometry arrived, the board had sent at most {r.lines_waiting_max} newer lines"
        )
        rows.insert(2, ("", text))
    if not r.simulated:
        rows.append(("left out", "lines on the wire: the benchmark cannot see them on a real port"))
    return rows
