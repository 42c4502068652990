"""`acsard bench`: measure how fast the daemon is on this machine."""

from __future__ import annotations

import argparse

from acsard.cli.common import Overrides, add_config, load

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
"""Longest measurement, s. Every sample stays in memory to the end: 60 MB at 100 Hz in this time."""


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb and its options."""
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
    """Return the number of seconds: an argparse type.

    Raises `ArgumentTypeError` below 1 s, and above the time whose samples fit into memory.
    """
    value = float(text)
    if not 1.0 <= value <= LONGEST_S:
        raise argparse.ArgumentTypeError(f"{text} is not from 1 to {LONGEST_S:g} s")
    return value


def main(args: argparse.Namespace) -> int:
    """Run the measurement and print its figures."""
    import signal

    import msgspec

    from acsard.bench.measure import bench_config, measure
    from acsard.bench.results_table import parts
    from acsard.daemon.serial.device import require
    from acsard.terminal.output import show

    port = "" if args.port in (None, "sim") else args.port
    if port:
        require(port)
    given: Overrides = {"control": {"rate": args.rate}} if args.rate is not None else {}
    _, config = load(args.config, given)
    # However this process is ended, the daemon and the far end of the port must end with it.
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    result = measure(bench_config(config, simulated=not port), port, args.seconds)
    if args.json:
        print(msgspec.json.encode(result).decode())
    else:
        show(*parts(result))
    return 0
