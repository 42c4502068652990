"""Measure the wheel radii and the effective track width, each with its standard deviation, and say
how much they improve the odometry. Without --log the tool drives the robot and guides a person at
this terminal through the drive. The person stands near the robot on a free floor of 3 m x 3 m,
starts each leg with Enter, stops it with any key, and types the tape measurements that the tool
asks for. The robot drives for at most 90 s. With --log the tool uses a recorded drive: a black-box
recording of a robot with a gyro, a ROS 2 bag in MCAP (its file or directory), or a CSV file with a
header. A bag has the wheels as JointState, and an Imu, a PoseStamped or an Odometry to compare them
with. Its topics are chosen by their types, or with --topic. The CSV file has the column t (s) and
the wheel speeds in rad/s, "fr,fl,rl,rr" or "left,right". It also has yaw_rate (rad/s, from a gyro),
or x and y (m, from any source of positions) with or without yaw (rad), or both. The column run (any
name) separates several drives. The columns may be in any order, and a cell is empty if its sensor
has no value then. A good log begins with 3 s of standing still. It contains straight drives, turns
to both sides, slow and fast, and curves, for 60 s or more. The exit code is 0 if the tool found the
values. Otherwise it is 1, and a message says what to do instead.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import msgspec

from acsard.calibration.calibration_report import Refusal, keys, parts, report
from acsard.calibration.guided.drive_plan import GuideError
from acsard.calibration.log_table import LogError, RefusedError
from acsard.calibration.multipliers import Tape
from acsard.calibration.recorded_drive import calibrated
from acsard.calibration.ros_bag_log import AXES, Choice
from acsard.cli.calibrate_drive import DRIVE_OPTIONS, add_drive_options, differing, guided
from acsard.cli.common import add_outcome, load, require_asking
from acsard.cli.connection import add_bus
from acsard.host.config_file import change, writable
from acsard.host.errors import Exit, MendableError, UsageError
from acsard.terminal.json_prompt import JsonPrompt
from acsard.terminal.output import SENTENCES, plain, show
from acsard.terminal.prompt import NobodyError

DRIVEN = "the drive"
"""The name of a guided drive in messages and reports, where a log has its file name."""


def add_options(parser: argparse.ArgumentParser) -> None:
    add_bus(parser)
    add_drive_options(parser)
    parser.add_argument(
        "--log",
        type=Path,
        metavar="FILE",
        help="recorded drive: a CSV file, a recording of `acsard recording` or a ROS 2 bag in MCAP",
    )
    parser.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="NAME",
        help="with --log and a ROS 2 bag: use this topic, if several fit. If it is an Imu, a "
        "PoseStamped or an Odometry, the wheels are compared with no other topic; repeat the "
        "option for more",
    )
    parser.add_argument(
        "--yaw-axis",
        choices=AXES,
        default="",
        help="with --log and a ROS 2 bag: the axis of the IMU that points up (default: z). -x "
        "means that x points down; write --yaw-axis=-x",
    )
    parser.add_argument(
        "--distance",
        type=_distance,
        metavar="[RUN=]METRES",
        help="with --log: the straight-line distance from the start to the end of a run, by "
        "tape measure. It determines how large the wheels are. Without RUN it applies to "
        "the straightest run",
    )
    add_outcome(parser, "the result")


def main(args: argparse.Namespace) -> int:
    if not args.json_lines or args.log:
        return _calibrate(args, None)
    require_asking(args)
    with JsonPrompt() as lines:
        return _calibrate(args, lines)


def _calibrate(args: argparse.Namespace, lines: JsonPrompt | None) -> int:
    _require_fitting(args)
    where, mine = load(args.config)
    if args.write:
        writable(args.config)
    source = str(args.log) if args.log else DRIVEN
    try:
        if args.log:
            found, config = calibrated(args.log, mine, args.distance, _choice(args)), mine
        else:
            found, config = guided(args, mine, where, lines)
    except (LogError, RefusedError, GuideError, NobodyError) as error:
        notes = tuple(getattr(error, "__notes__", ()))
        if args.json:
            print(msgspec.json.encode(Refusal(source, str(error), notes)).decode(), flush=True)
        behind = "".join(f"\nnote: {note}" for note in notes)
        raise MendableError(f"{source}: {error}{behind}") from None
    if args.write:
        change(Path(where), keys(found))
    told = report(source, found, config.drive, where if args.write else "")
    written = args.write
    if lines is None:
        if args.json:
            print(msgspec.json.encode(told).decode())
        else:
            show(*parts(told, found, where), most=SENTENCES)
    else:
        lines.result(plain(*parts(told, found, where), width=SENTENCES))
        trouble = differing(config, mine, where)
        written = written or lines.offer(args.config, keys(found), trouble)
    if written and not args.log:
        print("restart the daemon: it reads these values only when it starts", file=sys.stderr)
    return int(Exit.OK)


def _require_fitting(args: argparse.Namespace) -> None:
    """Raise `UsageError` for an option that does not fit a recorded drive, or a guided one."""
    if not args.log and args.distance:
        raise UsageError(
            "--distance goes with --log: a guided drive asks for the distances that it needs"
        )
    if not args.log and _choice(args) != Choice():
        raise UsageError("--topic and --yaw-axis go with --log: they choose within a ROS 2 bag")
    for name in DRIVE_OPTIONS if args.log else ():
        if getattr(args, name):
            option = "--" + name.replace("_", "-")
            raise UsageError(
                f"{option} is for a guided drive and --log for a recorded one: leave one out"
            )


def _choice(args: argparse.Namespace) -> Choice:
    return Choice(tuple(args.topic), args.yaw_axis)


def _distance(text: str) -> Tape:
    run, _, metres = text.rpartition("=")
    try:
        value = float(metres)
    except ValueError:
        value = math.nan
    if not 0.1 <= value <= 1e4:
        raise argparse.ArgumentTypeError(f"{text} is not a distance in m from 0.1 to 10000")
    return Tape(value, run)
