"""Measure the wheel radii and the effective track width, each with its standard deviation, and the
noise of the odometry. A value is written only if it is better on runs that its fit did not use.
"""

from __future__ import annotations

import argparse
import math
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
from msgspec.structs import replace

from acsard.bus.address import address_of
from acsard.calibration.guide import MIN_TAPE_M, SOURCE, Options, drive, require_own
from acsard.calibration.log import Log, LogError, read_file, with_distance
from acsard.calibration.plan import METHODS
from acsard.calibration.result import Refusal, Result, calibrate, text
from acsard.cli.common import add_config, add_outcome, load
from acsard.cli.robot_options import add_bus, require_one
from acsard.client.connection import open_connection
from acsard.core.config.settings import Config
from acsard.core.formatting import many
from acsard.core.messages.keys_and_roles import full_key
from acsard.host.config_file import change, writable
from acsard.host.errors import Exit, MendableError, NotDrivenError, UsageError
from acsard.host.terminal_modes import single_key_mode
from acsard.terminal.output import MAX_TEXT_WIDTH, show
from acsard.terminal.prompt import NobodyError, Prompt, TerminalPrompt, ended_by_signals

DRIVE = """\
Drive the robot, and guide a person at this terminal. The person stands near the robot on a free
floor of 3 m x 3 m, starts each leg with Enter, stops it with any key, and types the distances that
the tool asks for. The tool says first for how long the robot drives at most. At the end it asks
whether to write the result.
"""

LOG = """\
Use a recorded drive: a recording of a robot with a gyro, or a CSV file with commas and decimal
points, whose first line names the columns, in any order:

    t                     time, s
    fr,fl,rl,rr           speed of each wheel, rad/s; or the mean of each side:
    left,right
    yaw_rate              turn rate of a gyro, rad/s, positive to the left
    x,y                   position from another source than the wheels, m
    yaw                   heading from that source, rad; may be missing
    applied_linear,applied_angular   commands, m/s and rad/s; may be missing
    run                   name of the drive of this row; may be missing

The file needs t, the wheels, and yaw_rate or x and y. A cell is empty if its sensor has no value at
that time. deploy/calibration/bag_to_csv.py converts a ROS bag.

A good log begins with 3 s of standing still. Then it contains 60 s or more of straight drives, slow
and fast turns to both sides, and curves. The exit code is 1 if no value is better.
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(title="actions", required=True)
    guided = actions.add_parser(
        "drive", help="drive the robot, guided by this terminal", description=DRIVE
    )
    add_bus(guided)
    guided.add_argument(
        "--method",
        choices=tuple(METHODS),
        help="with what the wheels are compared (default: the gyro if odometry.gyro is true, else "
        "a tape measure)",
    )
    guided.add_argument(
        "--poses",
        metavar="KEY",
        help="for --method poses: the Zenoh key on which the robot's poses are published "
        "(PoseStamped or Odometry in JSON, msgpack or CDR), as `acsard topics` lists it, for "
        "example sim/pose, or a full key",
    )
    guided.add_argument(
        "--poses-at",
        metavar="ENDPOINT",
        help="address of the bus with the poses, if they are not on the daemon's own bus",
    )
    guided.add_argument(
        "--yes",
        action="store_true",
        help="start every leg without Enter (only with the built-in simulator)",
    )
    add_outcome(guided, "the result")
    guided.set_defaults(main=main_drive)
    recorded = actions.add_parser(
        "log",
        help="use a recorded drive",
        description=LOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    recorded.add_argument("file", type=Path, metavar="FILE", help="the recorded drive")
    add_config(recorded)
    recorded.add_argument(
        "--distance",
        type=_distance,
        metavar="[RUN=]METERS",
        help="the straight distance from the start to the end of the run RUN, by tape measure, "
        "which shows the size of the wheels. Without RUN, it is that of the straightest run",
    )
    add_outcome(recorded, "the result")
    recorded.set_defaults(main=main_log)


def _distance(typed: str) -> tuple[str, float]:
    run, _, metres = typed.rpartition("=")
    try:
        value = float(metres)
    except ValueError:
        value = math.nan
    if not MIN_TAPE_M <= value <= 1e4:
        raise argparse.ArgumentTypeError(
            f"{typed} is not a distance in m from {MIN_TAPE_M} to 10000"
        )
    return run, value


def main_log(args: argparse.Namespace) -> int:
    where, config = load(args.config)
    if args.write:
        writable(args.config)

    def log() -> tuple[Log, Config]:
        with Prompt(args.json) as prompt:
            prompt.doing(f"reading {args.file}")
            made = read_file(args.file)
        return with_distance(made, *args.distance) if args.distance else made, config

    _finished(args, where, str(args.file), log)
    return Exit.OK


def main_drive(args: argparse.Namespace) -> int:
    where, config = load(args.config)
    if args.write:
        writable(args.config)
    require_one(args)
    address = address_of(config, args.connect, args.id, args.tls)
    if (args.method == "poses") != bool(args.poses) and args.method:
        raise UsageError("--method poses and --poses KEY belong together: add the other one")
    if args.poses_at and not args.poses:
        raise UsageError("--poses-at is the bus of the key of --poses: give --poses KEY as well")
    if args.poses in ("odom", full_key(address.robot_id, "odom")):
        raise UsageError(
            "the daemon computes odom from the wheels, so odom cannot show their errors: give "
            "--poses the Zenoh key of another source"
        )
    if not (args.yes or sys.stdin.isatty()):
        raise UsageError(
            "a person at the terminal starts and stops each leg: run `acsard calibrate drive` in a "
            "terminal. Without one, use --yes (only with the built-in simulator) or `acsard "
            "calibrate log`"
        )
    options = Options(args.method, args.poses, args.poses_at, args.yes)

    def driven() -> tuple[Log, Config]:
        with (
            open_connection(address, SOURCE) as client,
            _prompt(args) as prompt,
        ):
            return drive(client, options, prompt, where if args.write else "", config)

    result, used = _finished(args, where, "the drive", driven)
    asks = not (args.write or args.yes or args.json)
    if args.write or (asks and _written(args.config, where, config, result, used)):
        print("restart the daemon: it uses the new calibration after a restart", file=sys.stderr)
    return Exit.OK


def _written(
    path: str | None, where: str, file_config: Config, result: Result, used: Config
) -> bool:
    # Asks whether to write the result into the file `where`, if this is possible.
    try:
        writable(path)
        require_own(used, file_config, where)
    except (MendableError, LogError) as error:
        print(f"\nthe values cannot be written: {error}", file=sys.stderr)
        return False
    if TerminalPrompt().ask(f"Write these values into {where}?", ("yes", "no")) == "no":
        print("nothing was written")
        return False
    change(Path(where), dict(result.settings))
    print(f"{where}: written")
    return True


def _finished(
    args: argparse.Namespace, where: str, source: str, get: Callable[[], tuple[Log, Config]]
) -> tuple[Result, Config]:
    # Returns the result, and the configuration that was in force.
    try:
        log, config = get()
        with Prompt(args.json) as prompt:
            prompt.doing(f"fitting {many(len(log.runs), 'run')}")
            result = calibrate(log, config, source)
    except (LogError, NotDrivenError, NobodyError) as error:
        notes = tuple(getattr(error, "__notes__", ()))
        if args.json:
            print(msgspec.json.encode(Refusal(source, str(error), notes)).decode(), flush=True)
        notes_text = "".join(f"\nnote: {note}" for note in notes)
        paragraphs = f"{source}: {error}{notes_text}".splitlines()
        fill = textwrap.TextWrapper(MAX_TEXT_WIDTH, break_long_words=False).fill
        wrapped = [fill(paragraph) for paragraph in paragraphs]
        raise MendableError("\n".join(wrapped)) from None
    trouble = None
    if args.write:
        try:
            change(Path(where), dict(result.settings))
            result = replace(result, written=where)
        except MendableError as error:
            trouble = error  # print the result of the long drive before the error
    if args.json:
        print(msgspec.json.encode(result).decode())
    else:
        show(*text(result, config, where), most=MAX_TEXT_WIDTH)
    if trouble is not None:
        raise trouble
    return result, config


@contextmanager
def _prompt(args: argparse.Namespace) -> Iterator[Prompt]:
    if args.yes:
        yield Prompt(args.json)
        return
    with ended_by_signals(), single_key_mode():
        yield TerminalPrompt(args.json)
