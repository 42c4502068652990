"""Measure how fast the daemon is on this machine. The tool starts its own daemon with a simulated
microcontroller; a daemon that already runs is not disturbed. From another process, the tool sends
commands to the new daemon, receives its messages, and prints the times listed below. It does not
say whether they are good. On a busy machine they are longer.

what is measured, and between which points (all on the same clock):
  command -> wire       from the call of put() in this process, at random times, until the first
                        byte of the line with that command can be read at the far end of the
                        port.
  feedback -> odometry  from the write of the last byte of a feedback line at the far end of the
                        port until a callback in this process receives the odometry of that line.
  processor, memory     of the daemon's process alone, read from /proc.
  start-up              from before fork and exec until the first byte of the first line.
Each command and each feedback line has another speed than the one before, so that the tool can
recognize it. A real wire adds 2.9 ms a line at 115200 baud, and an FTDI adapter adds its latency
timer.

With --port the tool uses the real microcontroller. It sends only zero speeds, so nothing moves. The
tool cannot observe the far end of a real wire, so it omits all times that begin or end there. Stop
the robot's daemon first.
"""

from __future__ import annotations

import argparse
import signal

import msgspec

from acsard.bench.measure import bench_config, measure
from acsard.bench.results_table import parts
from acsard.cli.common import add_config, load, seconds
from acsard.daemon.serial.device import require
from acsard.terminal.output import show


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    add_config(parser)
    parser.add_argument(
        "--seconds",
        type=seconds,
        default=20.0,
        metavar="N",
        help="duration of the measurement in seconds (default: 20)",
    )
    parser.add_argument(
        "--port",
        metavar="DEVICE",
        help="measure with the microcontroller at this serial port; acsard sends only zero speeds "
        "to it (default: sim, the built-in simulator, even if the configuration names a port)",
    )
    parser.add_argument(
        "--rate", type=float, metavar="HZ", help="control rate, Hz (default: the configured rate)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def main(args: argparse.Namespace) -> int:
    port = "" if args.port in (None, "sim") else args.port
    if port:
        require(port)
    _, config = load(args.config, {"control.rate": args.rate})
    # The daemon and the process at the far end of the port must end with this process, also if a
    # signal ends it.
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    result = measure(bench_config(config, simulated=not port), port, args.seconds)
    if args.json:
        print(msgspec.json.encode(result).decode())
    else:
        show(*parts(result))
    return 0
