"""`acsard calibrate`: find wheel radii and effective track from a guided or a recorded drive.

The package `calibration` computes them; `calibrate_drive.py` runs the guided drive.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from acsard.cli.calibrate_drive import DRIVE_OPTIONS, add_options, differing, guided
from acsard.cli.common import JSON_LINES, add_bus, load
from acsard.host.config_file import change, writable
from acsard.host.errors import Exit, ExitError, UsageError

if TYPE_CHECKING:
    from acsard.calibration.solve import Calibration
    from acsard.calibration.tape_distance import Tape
    from acsard.core.config.settings import DriveConfig
    from acsard.prompts.json_prompt import JsonPrompt

DESCRIPTION = """\
Find the wheels' radii and the effective track, each with its standard deviation, and tell what they
improve. Without --log the robot is driven, guided in words: a person at this terminal stands beside
it on a free floor of 3 m x 3 m, starts each leg by Enter, stops it by any key, and reads off a tape
what is asked for; at most 90 s of driving. With --log from a drive that was recorded: by the black
box of a robot with a gyro, as it is, or a CSV file with a header: column t (s) and the wheel speeds
in rad/s, "fr,fl,rl,rr" or "left,right"; and yaw_rate (rad/s, of a gyro), or x and y (m, of any
source of positions) with or without yaw (rad), or both; run (any name) tells several drives apart.
Columns may be in any order, cells empty where a sensor has nothing to say. Good logs begin with 3 s
of standing, and have straight drives, turns to both sides, slow and fast, and curves, for 60 s or
more. Exit 0 when something was found, 1 when not, with what to do instead.
"""

DRIVEN = "the drive"
"""The name of a guided drive in messages and reports, where a log has its file name."""

MOST_BYTES = 1 << 30
"""Largest log in bytes. The whole log is read into memory."""


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb and its options."""
    parser = verbs.add_parser(
        "calibrate",
        help="wheel radii and effective track, by a guided drive or from a recorded one",
        description=DESCRIPTION,
    )
    add_bus(parser)
    add_options(parser)
    parser.add_argument(
        "--log",
        type=Path,
        metavar="FILE",
        help="a recorded drive, CSV or one of `acsard recording`",
    )
    parser.add_argument(
        "--distance",
        type=_distance,
        metavar="[RUN=]METRES",
        help="with --log: how far from its start a run ends, in a straight line by tape measure: "
        "tells how large the wheels are; without RUN it is the straightest run",
    )
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--json", action="store_true", help="print one JSON object")
    how.add_argument("--json-lines", action="store_true", help=JSON_LINES)
    parser.add_argument(
        "--write",
        action="store_true",
        help="also write what was found into the configuration file, comments kept (needs the "
        "library tomlkit; without it, it tells what to type)",
    )
    parser.set_defaults(main=main)


def main(args: argparse.Namespace) -> int:
    """Run the calibration and print its result."""
    if not args.json_lines or args.log:
        return _calibrate(args, None)
    if args.yes:
        raise UsageError("--yes asks nobody, and --json-lines a program: one of both")
    from acsard.prompts.json_prompt import JsonPrompt

    with JsonPrompt() as lines:
        return _calibrate(args, lines)


def _calibrate(args: argparse.Namespace, lines: JsonPrompt | None) -> int:
    import msgspec

    from acsard.calibration.calibration_report import Refusal, keys, parts, report
    from acsard.calibration.doubts import RefusedError
    from acsard.calibration.guided.legs import GuideError
    from acsard.calibration.log_table import LogError
    from acsard.prompts.prompt import NobodyError
    from acsard.terminal.output import SENTENCES, plain, show

    where, mine = load(args.config)
    if args.write:
        writable(args.config)
    source = str(args.log) if args.log else DRIVEN
    try:
        if args.log:
            found, config = _calibrated(_only_log(args), mine.drive, args.distance), mine
        else:
            found, config = guided(_no_log(args), mine, where, lines)
    except (LogError, RefusedError, GuideError, NobodyError) as error:
        notes = tuple(getattr(error, "__notes__", ()))
        if args.json:
            print(msgspec.json.encode(Refusal(source, str(error), notes)).decode(), flush=True)
        behind = "".join(f"\nnote: {note}" for note in notes)
        raise ExitError(Exit.FAILURE, f"{source}: {error}{behind}") from None
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
        print("restart the daemon: it takes them at its start", file=sys.stderr)
    return int(Exit.OK)


def _only_log(args: argparse.Namespace) -> Path:
    """Return the log's path.

    Raises `UsageError` if an option was given that only a guided drive takes.
    """
    for name in DRIVE_OPTIONS:
        if getattr(args, name):
            option = "--" + name.replace("_", "-")
            raise UsageError(
                f"{option} is for a guided drive, --log for a recorded one: one of both"
            )
    log: Path = args.log
    return log


def _no_log(args: argparse.Namespace) -> argparse.Namespace:
    if args.distance:
        raise UsageError("--distance goes with --log; a guided drive asks for what it needs")
    return args


def _calibrated(log: Path, drive: DriveConfig, tape: Tape | None) -> Calibration:
    from acsard.calibration.log_table import AS_CSV, LogError, noted, read
    from acsard.calibration.runs import runs
    from acsard.calibration.solve import calibrate
    from acsard.recording.mcap_records import MAGIC

    if log.is_dir():
        raise LogError(f"it is a directory (a bag of ROS, perhaps): {AS_CSV}")
    try:
        if log.stat().st_size > MOST_BYTES:
            raise ExitError(Exit.FAILURE, f"{log} is over 1 GiB: cut it, ten minutes are plenty")
        data = log.read_bytes()
    except OSError as error:
        raise ExitError(
            Exit.FAILURE, f"cannot read {log}: {error.strerror}; correct --log"
        ) from None
    if data.startswith(MAGIC):
        data = _measured(log)
    table = read(data)
    try:
        driven = runs(table)
    except LogError as error:
        noted(error, table.notes)
        raise
    return calibrate(driven, drive, tape)


def _measured(log: Path) -> bytes:
    """Return the measurements of a black-box recording as a CSV table.

    Raises `LogError` if the file is not a recording or if the recording has no gyro.
    """
    from acsard.calibration.log_table import AS_CSV, LogError
    from acsard.host.errors import RecordingError
    from acsard.recording.export import measured
    from acsard.recording.file import Recording

    try:
        recording = Recording(log)
    except RecordingError as error:
        raise LogError(f"{error}; {AS_CSV}") from None
    try:
        return measured(recording)
    except RecordingError as error:
        raise LogError(str(error)) from None


def _distance(text: str) -> Tape:
    from acsard.calibration.tape_distance import Tape

    run, _, metres = text.rpartition("=")
    try:
        value = float(metres)
    except ValueError:
        value = math.nan
    if not 0.1 <= value <= 1e4:
        raise argparse.ArgumentTypeError(f"{text} is not a distance in m from 0.1 to 10000")
    return Tape(value, run)
