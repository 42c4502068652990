"""Runs one benchmark and computes the figures from its record."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from tempfile import TemporaryDirectory

from msgspec.structs import replace

from acsard.bench.matching import (
    Summary,
    command_waits,
    feedback_fates,
    lines_of,
    staircase,
    summary,
)
from acsard.bench.results_table import Result, this_machine
from acsard.bench.rig import Rig, resident_mb
from acsard.core.config.parsing import effective
from acsard.core.config.settings import (
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
from acsard.core.config.toml_text import document
from acsard.core.messages.schema import RobotState
from acsard.host import real_time
from acsard.host.errors import MendableError


def bench_config(config: Config, *, simulated: bool) -> Config:
    """Return `config` for the measured daemon, with its own robot id, bus and command source.

    The rates, the log and the state directory have their default values. If `simulated` is true,
    further settings change:

    - The limits are so high that the line after a command contains exactly the speeds of the
      command.
    - Feedback that contradicts the commands does not count as a fault.
    - Lines have no sequence number, because the benchmark recognizes a line by its text.
    - The robot becomes active by itself, and drive, simulator and encoders have default values.
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
    """Return an endpoint on the loopback interface on which no process listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def write(config: Config, where: Path) -> Path:
    file = where / "acsard.toml"
    file.write_text("\n".join(document(effective(config))) + "\n", encoding="utf-8")
    return file


def measure(config: Config, port: str, seconds: float) -> Result:
    """Run a daemon, measure it for `seconds` s, and return the figures.

    In the first quarter of this time, the benchmark sends no commands. `port` is the serial port;
    "" means the simulated board. On a real port, all commands are zero.
    """
    with TemporaryDirectory(prefix="acsard-bench-") as where:
        file = write(config, Path(where))
        with Rig(config, file, port=port) as rig:
            followed = rig.follow(seconds / 4)
            commanded = rig.command(seconds * 3 / 4, (lambda _: 0.0) if port else staircase)
            return _result(config, port, seconds, rig, (followed, commanded))


def _own(state: RobotState) -> dict[str, Summary]:
    spreads = {name: figure.since_start for name, figure in state.latencies.items()}
    return {
        name: Summary(s.count, round(s.p50, 1), round(s.p99, 1), round(s.max, 1))
        for name, s in spreads.items()
    }


def _result(
    config: Config, port: str, seconds: float, rig: Rig, shares: tuple[float, float]
) -> Result:
    state, pid = rig.state(), rig.process.pid
    realtime = bool(real_time.is_real_time(pid))
    resident = resident_mb(pid)
    record = rig.end()
    read = [sample.at.wall_ns - sample.stamp_ns for sample in record.samples]
    outside = {"read_to_odometry": summary(read)}
    wire_count = lines_said = lines_waiting = start_up = None
    lines_told = len(record.samples)
    if record.seen is not None:
        daemon_lines = lines_of(record.seen.from_daemon)
        waits, fed = command_waits(record), feedback_fates(config, record)
        outside["command_to_wire"] = summary(waits)
        outside["feedback_to_odometry"] = summary([line.delay_ns for line in fed])
        wire_count, lines_said, lines_told = len(waits), len(record.feedback_lines), len(fed)
        if record.sent and not wire_count:
            raise MendableError(
                f"the simulated microcontroller received none of the {len(record.sent)} commands, "
                f"so the benchmark measured nothing. The daemon reports: {state.reason}"
            )
        lines_waiting = max((line.waiting for line in fed), default=0)
        start_up = round((daemon_lines[0][0] - record.began_ns) / 1e6, 1)
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
        commands_seen=wire_count,
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
