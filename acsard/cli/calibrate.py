"""Measure the wheel radii and the effective track width, each with its standard
deviation, and say how much they improve the odometry. If the tool has data of a
gyro or positions, it also estimates the noise settings of [odometry].

Without --log the tool drives the robot and guides a person at this terminal
through the drive. The person stands near the robot on a free floor of 3 m x 3 m,
starts each leg with Enter, stops it with any key, and types the tape measurements
that the tool asks for. The robot drives for at most 90 s.

With --log the tool uses a recorded drive: a black-box recording of a robot with a
gyro, or a CSV file with commas and decimal points, whose first line names the
columns, in any order:

    t                     time, s
    fr,fl,rl,rr           speed of each wheel, rad/s; or the mean of each side:
    left,right
    yaw_rate              turn rate of a gyro, rad/s, positive to the left
    x,y                   position from another source than the wheels, m
    yaw                   heading from that source, rad; may be missing
    applied_linear,applied_angular   commands, m/s and rad/s; may be missing
    run                   name of the drive of this row; may be missing

The file needs t, the wheels, and yaw_rate or x and y. A cell is empty if its sensor
has no value at that time. deploy/calibration/bag_to_csv.py converts a ROS bag.

A good log begins with 3 s of standing still. Then it contains 60 s or more of
straight drives, slow and fast turns to both sides, and curves.

The exit code is 0 if the tool found the values. Otherwise it is 1, and a message
says what to do instead.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from acsard.bus.address import address_of
from acsard.calibration.calibration_report import CalibrationRefusal, keys, parts, report
from acsard.calibration.guided.drive_plan import NEEDS, GuideError
from acsard.calibration.guided.guided_drive import DriveOptions, guided_drive
from acsard.calibration.guided.robot_on_bus import SOURCE
from acsard.calibration.log_table import LogError, NoCalibrationError
from acsard.calibration.multipliers import Tape
from acsard.calibration.recorded_drive import calibrated
from acsard.calibration.solve import Calibration
from acsard.cli.common import add_outcome, load
from acsard.cli.connection import add_bus, require_one
from acsard.client.connection import open_connection
from acsard.core.config.settings import Config
from acsard.core.messages.keys_and_roles import full_key
from acsard.host.config_file import change, writable
from acsard.host.errors import Exit, MendableError, UsageError
from acsard.host.terminal_modes import single_key_mode
from acsard.terminal.output import MAX_TEXT_WIDTH, show
from acsard.terminal.prompt import NobodyError, Prompt, TerminalPrompt, ended_by_signals

# Options of a guided drive, not with `--log`.
DRIVE_OPTIONS = ("method", "positions", "positions_at", "imu", "yes")


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    add_bus(parser)
    _add_drive_options(parser)
    parser.add_argument(
        "--log",
        type=Path,
        metavar="FILE",
        help="calibrate from a recorded drive, without driving: FILE is a CSV file or a recording "
        "of `acsard recording`",
    )
    parser.add_argument(
        "--distance",
        type=_distance,
        metavar="[RUN=]METERS",
        help="with --log: the straight-line distance from the start to the end of the run RUN, "
        "by tape measure. acsard computes the size of the wheels from this distance. Without RUN, "
        "METERS is the distance of the straightest run",
    )
    add_outcome(parser, "the result")


def main(args: argparse.Namespace) -> int:
    _require_fitting(args)
    where, local_config = load(args.config)
    if args.write:
        writable(args.config)
    # Messages and reports name a recorded drive by the path of its file.
    source = str(args.log) if args.log else "the drive"
    try:
        if args.log:
            calibration = calibrated(args.log, local_config, args.distance)
            config = local_config
        else:
            calibration, config = _guided(args, where, local_config)
    except (LogError, NoCalibrationError, GuideError, NobodyError) as error:
        notes = tuple(getattr(error, "__notes__", ()))
        if args.json:
            print(
                msgspec.json.encode(CalibrationRefusal(source, str(error), notes)).decode(),
                flush=True,
            )
        notes_text = "".join(f"\nnote: {note}" for note in notes)
        raise MendableError(f"{source}: {error}{notes_text}") from None
    written, trouble = "", None
    if args.write:
        try:
            change(Path(where), keys(calibration))
            written = where
        except MendableError as error:
            # Print the result of the long drive before the error.
            trouble = error
    result = report(source, calibration, config.drive, written)
    if args.json:
        print(msgspec.json.encode(result).decode())
    else:
        show(*parts(result, calibration, where, guided=not args.log), most=MAX_TEXT_WIDTH)
    if trouble is not None:
        raise trouble
    if written and not args.log:
        print(
            "restart the daemon: it uses the new calibration only after a restart", file=sys.stderr
        )
    return Exit.OK


def _require_fitting(args: argparse.Namespace) -> None:
    if not args.log and args.distance:
        raise UsageError(
            "--distance needs --log: without --log, acsard asks for the distances that it needs"
        )
    for name in DRIVE_OPTIONS if args.log else ():
        if getattr(args, name):
            option = "--" + name.replace("_", "-")
            raise UsageError(
                f"{option} is for a guided drive, but --log reads a recorded drive: leave one of "
                "the two options out"
            )


def _distance(text: str) -> Tape:
    run, _, metres = text.rpartition("=")
    try:
        value = float(metres)
    except ValueError:
        value = math.nan
    if not 0.1 <= value <= 1e4:
        raise argparse.ArgumentTypeError(f"{text} is not a distance in m from 0.1 to 10000")
    return Tape(value, run)


def _add_drive_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--method",
        choices=tuple(NEEDS),
        help="reference with which the wheels are compared (default: the gyro if odometry.gyro is "
        "true, else a tape measure)",
    )
    parser.add_argument(
        "--positions",
        metavar="KEY",
        help="for --method positions: the Zenoh key on which the robot's positions are published "
        "(PoseStamped or Odometry in JSON, msgpack or CDR). Give a key as `acsard topics` lists "
        "it, for example sim/pose, or a full key",
    )
    parser.add_argument(
        "--positions-at",
        metavar="ENDPOINT",
        help="address of the bus on which the positions are published, for example of a router; "
        "needed only if they are not on the daemon's own bus",
    )
    parser.add_argument(
        "--imu",
        metavar="KEY",
        help="for --method gyro: the Zenoh key of the gyro (default: imu), as `acsard topics` "
        "lists it, or a full key",
    )
    parser.add_argument(
        "--yes",
        action="store_true",
        help="start every leg of the drive without waiting for Enter (only with the built-in "
        "simulator)",
    )


def _guided(args: argparse.Namespace, file: str, file_config: Config) -> tuple[Calibration, Config]:
    require_one(args)
    where = address_of(file_config, args.connect, args.id, args.tls)
    _usable(args, full_key(where.robot_id, "odom"))
    options = DriveOptions(args.method, args.positions, args.positions_at, args.imu, args.yes)
    with open_connection(where, SOURCE) as client:
        return guided_drive(
            client, options, file, file_config, _prompt(args), must_write=args.write
        )


def _usable(args: argparse.Namespace, odometry: str) -> None:
    if args.method == "positions" and not args.positions:
        raise UsageError(
            "--method positions needs the Zenoh key of the positions: add --positions KEY"
        )
    if args.positions and args.method not in (None, "positions"):
        raise UsageError(f"--positions is not for --method {args.method}: leave one of them out")
    if args.positions in ("odom", odometry):
        raise UsageError(
            "the daemon computes odom from the wheels, so odom cannot show the errors of the "
            "wheels: give --positions the Zenoh key of another source"
        )
    if args.imu and (args.positions or args.method not in (None, "gyro")):
        other = "--positions" if args.positions else f"--method {args.method}"
        raise UsageError(f"--imu is for --method gyro, not for {other}: leave one of them out")
    if args.positions_at and not args.positions:
        raise UsageError(
            "--positions-at names the bus address of the key of --positions: give --positions KEY "
            "as well"
        )
    if not (args.yes or sys.stdin.isatty()):
        raise UsageError(
            "`acsard calibrate` drives the robot, and a person at the terminal starts and stops "
            "each leg: run `acsard calibrate` in a terminal. Without a terminal, use --yes (only "
            "with the built-in simulator), or --log with a recorded drive"
        )


@contextmanager
def _prompt(args: argparse.Namespace) -> Iterator[Prompt]:
    if args.yes:
        yield Prompt(args.json)
        return
    with ended_by_signals(), single_key_mode():
        yield TerminalPrompt(args.json)
