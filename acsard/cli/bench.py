"""`acsard bench`: how fast is it on this machine?"""

from __future__ import annotations

import argparse
import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING

from acsard.cli.common import Overrides, add_config, load
from acsard.host.exits import Exit, ExitError

if TYPE_CHECKING:
    from acsard.bench.matching import Summary
    from acsard.bench.rig import Rig
    from acsard.bench.table import Result
    from acsard.config.settings import Config
    from acsard.messages.schema import RobotState

_DESCRIPTION = """\
Measure this machine: run a daemon of its own (beside one that already runs) on a
simulated microcontroller with plain lines, follow and command it from another
process, and print how long things take. Nothing is asserted; a busy machine gives worse figures.

what is measured, and between which points (all on one clock):
  command -> wire       the call of put() here, in another process, at random times ->
                        the first byte of the line that says it can be read at the far
                        end of the port. A wire's own time (2.9 ms a line at 115200
                        baud) comes after that.
  feedback -> odometry  the last byte of a feedback line handed to the far end of the
                        port -> the odometry of that very line in a callback here.
  processor, memory     of the daemon's process alone, by /proc.
  start-up              before fork and exec -> the first byte of the first line.
Every command and every feedback line says a speed of its own, so that each is found
again by what it says. A real wire adds its own time, an FTDI adapter its timer.

With --port the real microcontroller is used: only zero speeds are sent, so nothing
moves, and what happens on the wire cannot be seen and is left out. Stop the robot's
daemon first.
"""


LONGEST_S = 600.0
"""Every sample is kept to the end: at 100 Hz 60 MB of them in this time."""


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "bench",
        help="measure how fast it is on this machine",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_config(parser)
    parser.add_argument(
        "--seconds", type=duration, default=20.0, metavar="N", help="how long (default: 20)"
    )
    parser.add_argument(
        "--port",
        metavar="DEVICE",
        help="measure with the microcontroller on this serial port, at zero speed "
        "(default: sim, a simulated one, whatever the configuration says)",
    )
    parser.add_argument("--rate", type=float, metavar="HZ", help="control rate, else as configured")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(main=main)


def duration(text: str) -> float:
    """An argparse type: seconds, at least one, and not more than memory holds the samples of."""
    value = float(text)
    if not 1.0 <= value <= LONGEST_S:
        raise argparse.ArgumentTypeError(f"{text} is not from 1 to {LONGEST_S:g} s")
    return value


def main(args: argparse.Namespace) -> int:
    """Measure and print."""
    import signal

    import msgspec

    from acsard.bench.table import table

    port = "" if args.port in (None, "sim") else args.port
    if port:
        check_device(port)
    given: Overrides = {"control": {"rate": args.rate}} if args.rate is not None else {}
    _, config = load(args.config, given)
    # Whoever ends us, the daemon and the far end must not stay behind.
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    result = measure(bench_config(config, simulated=not port), port, args.seconds)
    print(msgspec.json.encode(result).decode() if args.json else table(result))
    return 0


def check_device(port: str) -> None:
    """Raises when it is no device: a daemon waits for its port, a benchmark must not."""
    try:
        mode = os.stat(port).st_mode
    except FileNotFoundError:
        raise ExitError(
            Exit.NO_PORT, f"{port} is not there; `acsard ports` lists what is"
        ) from None
    except OSError as error:
        raise ExitError(Exit.NO_PORT, f"{port}: {error.strerror}") from None
    if not stat.S_ISCHR(mode):
        raise ExitError(
            Exit.NO_PORT,
            f"{port} is not a serial port (no character device); `acsard ports` lists what is",
        )


def bench_config(config: Config, *, simulated: bool) -> Config:
    """The configuration to measure with: a name, a bus and a commander of its own.

    On the simulator nothing may hide a command or doubt a made-up feedback: it goes into the next
    line whole, and feedback that has nothing to do with it is no fault. Lines are plain there: a
    checked one has a number of its own and is not recognised by the speed it says.
    """
    from msgspec.structs import replace

    from acsard.bench.rig import free_endpoint
    from acsard.config.settings import (
        BusConfig,
        CommandsConfig,
        DriveConfig,
        FeedbackConfig,
        LimitsConfig,
        LogConfig,
        RatesConfig,
        RobotConfig,
        SimConfig,
        Source,
    )

    own = replace(
        config,
        robot=RobotConfig(f"bench-{os.getpid()}"),
        bus=BusConfig(listen=(free_endpoint(),)),
        commands=CommandsConfig(sources=(Source("bench", 100),)),
        rates=RatesConfig(),
        log=LogConfig(),
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


def write(config: Config, where: Path) -> Path:
    """The configuration as a file."""
    from acsard.cli.check import toml
    from acsard.config.parsing import effective

    file = where / "acsard.toml"
    file.write_text("\n".join(toml(effective(config))) + "\n", encoding="utf-8")
    return file


def measure(config: Config, port: str, seconds: float) -> Result:
    """A quarter of the time only followed, then commanded as well."""
    from tempfile import TemporaryDirectory

    from acsard.bench.matching import staircase
    from acsard.bench.rig import Rig

    with TemporaryDirectory(prefix="acsard-bench-") as where:
        file = write(config, Path(where))
        with Rig(config, file, port=port) as rig:
            followed = rig.follow(seconds / 4)
            commanded = rig.command(seconds * 3 / 4, (lambda _: 0.0) if port else staircase)
            return _result(config, port, seconds, rig, (followed, commanded))


def _own(state: RobotState) -> dict[str, Summary]:
    from acsard.bench.matching import Summary

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
    from acsard.bench.child import resident_mb
    from acsard.bench.matching import lines_of, summary
    from acsard.bench.record import command_waits, feedback_fates
    from acsard.bench.table import Result, this_machine

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
