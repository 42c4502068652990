"""Work with the recordings that the daemon has made. Without a subcommand, list them, oldest
first. The argument FILE of a subcommand is the file of a recording, or its number in the list. With
--from or --to and without FILE, a subcommand takes the part of all recordings between these times;
without them, it takes the newest recording.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import msgspec

from acsard.cli.common import load
from acsard.cli.time_range import AFTER_EXAMPLE, TIME_EXAMPLES, TimeError, time_range
from acsard.core.formatting import json_line, printable
from acsard.core.values import NS_PER_S, WallNs
from acsard.host.errors import Exit, ExitError, MendableError, UsageError
from acsard.host.version import version
from acsard.recording.directory import is_being_recorded
from acsard.recording.export import ENDINGS, Kind, export, replacing
from acsard.recording.file import (
    ALWAYS,
    Head,
    ReadRecord,
    Recording,
    first_head,
    listed,
    number_of,
)
from acsard.recording.html_report import KEYS, Drawing, page
from acsard.recording.published import published
from acsard.recording.recorded_steps import RecordedStep
from acsard.recording.replay import Playback, config_of
from acsard.recording.replay_text import (
    describe_difference,
    describe_missing,
    describe_outcome,
    explain_settings,
    explain_verdict,
    verdict,
)
from acsard.recording.timeline import Timeline, TimelineEntry
from acsard.terminal.output import show, table

SERVICE_DIRECTORY = Path("/var/lib/acsard/record")  # of the systemd service

PROGRESS_RECORDS = 1024  # between two times on the terminal

REPLAY_DESCRIPTION = """\
Run the recorded inputs through the program again, without a robot, and compare the results with the
recorded ones: each line to the board, and each pose, mode, reason and event. With --config, show
what another configuration would have changed. A part that is damaged or missing is not compared.
Exit codes: 0 everything is the same, 1 something differs (as it may if another version recorded
it), 65 a part was not compared and the rest is the same. With --config, a difference is no failure.
"""

EXPORT_DESCRIPTION = """\
Write the messages of a recorded robot as a file for Foxglove, Lichtblick, PlotJuggler and `ros2 bag
play`. The file is MCAP with odom, tf, tf_static, joint_states, cmd_vel_out, cmd_vel_in of each
source, diagnostics, state and log as ROS 2 messages, and with their definitions. With --config,
write the messages that the robot would have published with another configuration. Exit codes: 0
all steps in the recording are written, 65 a damaged part, which cannot be read, is left out.
"""

REPORT_DESCRIPTION = """\
Draw a recording as one HTML file that needs no network. A part that cannot be read because of
damage is left out and named; the exit code stays 0.
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    _selection(parser, None)
    actions = parser.add_subparsers(title="subcommands", metavar="SUBCOMMAND")
    view = actions.add_parser(
        "show",
        help="print the events of a recording as text",
        description="Print the events of a recording as text, one line per event. A line `gap` "
        "shows where steps are missing.",
    )
    replay = actions.add_parser(
        "replay",
        help="run the recorded inputs through the program again, without a robot, and compare the "
        "results",
        description=REPLAY_DESCRIPTION,
    )
    exported = actions.add_parser(
        "export",
        help="convert a recording to a file for Foxglove, PlotJuggler or ros2 bag, or to a table",
        description=EXPORT_DESCRIPTION,
    )
    drawn = actions.add_parser(
        "report",
        help="draw the robot's path and speeds, the command sources, the serial link and the "
        "events of a recording, as one HTML file",
        description=REPORT_DESCRIPTION,
    )
    view.set_defaults(main=main_show)
    replay.set_defaults(main=main_replay)
    exported.set_defaults(main=main_export)
    drawn.set_defaults(main=main_report)
    for action in (view, replay, exported, drawn):
        action.add_argument(
            "file",
            nargs="?",
            metavar="FILE",
            help="file of a recording, or its number in the list of `acsard recording` (default: "
            "all with --from or --to, otherwise the newest)",
        )
        _selection(action, argparse.SUPPRESS)
    view.add_argument("--json", action="store_true", help="print each event as a line of JSON")
    for action, name in ((exported, "NEW"), (drawn, "NEW.html")):
        action.add_argument(
            "new",
            nargs="?",
            metavar=name,
            help="file to write (default: named after the recording, in the working directory)",
        )
        action.add_argument("--force", action="store_true", help="overwrite an existing file")
    exported.add_argument(
        "--csv",
        dest="kind",
        action="store_const",
        const="csv",
        default="mcap",
        help="write a CSV table with one row per feedback line; its first columns are those that "
        "`acsard calibrate log` reads",
    )
    for action in (replay, exported):
        action.add_argument(
            "--config",
            metavar="FILE",
            help="another acsard.toml to use instead of the recorded configuration",
        )


def _selection(parser: argparse.ArgumentParser, default: object) -> None:
    parser.add_argument(
        "--directory",
        default=default,
        metavar="DIRECTORY",
        help=f"directory of the recordings (default: record.directory, or {SERVICE_DIRECTORY})",
    )
    for option, name, more in (("--from", "begin", ""), ("--to", "end", f", {AFTER_EXAMPLE}")):
        parser.add_argument(
            option,
            dest=name,
            default=default,
            metavar="TIME",
            help=f"for example {TIME_EXAMPLES}{more}",
        )


def main(args: argparse.Namespace) -> int:
    begin_ns, end_ns = _range(args)
    where, files = _files(args)
    rows = []
    for path in files:
        try:
            head, status = first_head(path), path.stat()
        except FileNotFoundError:
            # The daemon has removed the file after it was listed.
            continue
        except OSError as error:
            rows.append((path.name, "", "", f"cannot be read: {error.strerror}"))
            continue
        size = f"{status.st_size / 1000:.0f} kB"
        if head is None:
            rows.append((path.name, "", size, "the beginning cannot be read"))
        elif _overlaps(head, status, begin_ns, end_ns):
            note = " [being recorded]" if is_being_recorded(path, time.time()) else ""
            by = f"acsard {printable(head.version)}{note}"
            rows.append((path.name, _clock(head.wall_ns), size, by))
    if rows:
        show(table(rows, right={2}))
    else:
        words = " in that time: leave out --from and --to to list all" if files else ""
        print(f"no recordings in {where}{words}")
    return Exit.OK


def main_show(args: argparse.Namespace) -> int:
    recording, timeline, is_empty = _recording(args), Timeline(), True
    for record in recording.records():
        if recording.includes(record):
            for entry in timeline.take(record):
                is_empty = False
                _print_entry(entry, args.json)
    if is_empty:
        raise recording.nothing()
    _note_damage(recording)
    return Exit.OK


def _print_entry(entry: TimelineEntry, as_json: bool) -> None:
    if as_json:
        print(json_line(msgspec.json.encode(entry).decode()))
    else:
        mark = {"warning": "! ", "error": "!! "}.get(entry.level, "")
        milliseconds = entry.wall_ns // 1_000_000 % 1000
        at = f"{_clock(entry.wall_ns)}.{milliseconds:03}"
        print(printable(f"{at}  {mark}{entry.name.replace('_', ' ')}: {entry.sentence}"))


def main_replay(args: argparse.Namespace) -> int:
    """Replay a recording, print how the results differ, and return the exit code.

    It is 1 if they differ without --config, otherwise 65 if a part was not compared.
    """
    other = None if args.config is None else load(args.config)[1]
    recording = _with_progress(args)
    playback, head = Playback(recording, other), recording.head()
    for _ in playback.steps():
        pass
    comparison = playback.comparison
    if head is None or not comparison.steps:
        raise recording.nothing()
    print(f"{verdict(comparison)}\n{explain_verdict(other is not None)}")
    if head.version != version():
        by = f"acsard {printable(head.version)} recorded this, and acsard {version()} replayed it"
        print(f"{by}: a difference may come from what changed between them")
    rows, began_ns = list[str](), head.mono_ns
    if other is not None:
        rows = explain_settings(config_of(head), other, comparison, began_ns)
    if comparison.first is not None:
        difference = describe_difference(comparison.first, began_ns)
        rows = [*difference, *rows, *describe_outcome(comparison)]
    rows += filter(None, [playback.failed_step()])
    for row in rows:
        print(printable(row))
    left_out = describe_missing(playback.gaps, recording.damage, "not compared")
    for row in left_out:
        print(printable(row), file=sys.stderr)
    if not comparison.same and other is None:
        return Exit.FAILURE
    return Exit.INCOMPLETE if left_out else Exit.OK


def main_export(args: argparse.Namespace) -> int:
    kind: Kind = args.kind
    other = None if args.config is None else load(args.config)[1]
    recording = _with_progress(args)
    new = _new(args, recording, ENDINGS[kind])
    with _written(new):
        count = export(recording, new, kind, other, args.force)
    print(f"{count} {'rows' if kind == 'csv' else 'messages'} in {new}")
    return Exit.INCOMPLETE if _note_damage(recording) else Exit.OK


def main_report(args: argparse.Namespace) -> int:
    recording = _with_progress(args)
    new, head = _new(args, recording, ".html"), recording.head()
    if head is None:
        raise recording.nothing()
    with _written(new), replacing(new, args.force) as file:
        drawing = Drawing(published(recording, keys=KEYS))
        text = page(drawing, head.robot, [str(damage) for damage in recording.damage])
        file.write_text(text, encoding="utf-8")
    print(f"{new}: {len(text) / 1e6:.1f} MB; open it in any browser")
    _note_damage(recording)
    return Exit.OK


def _range(args: argparse.Namespace) -> tuple[WallNs, WallNs]:
    try:
        begin_ns, end_ns = time_range(args.begin, args.end, datetime.now())
    except TimeError as error:
        raise UsageError(str(error)) from None
    return ALWAYS[0] if begin_ns is None else begin_ns, ALWAYS[1] if end_ns is None else end_ns


def _recording(args: argparse.Namespace) -> Recording:
    return Recording(_chosen(args), *_range(args))


def _chosen(args: argparse.Namespace) -> list[Path]:
    name = args.file
    if name is not None and not re.fullmatch(r"\d{1,9}", name):
        if Path(name).suffix in (*ENDINGS.values(), ".html") and not Path(name).exists():
            raise UsageError(
                f"to write {name}, type the recording's number before it, such as `1 {name}`; "
                "`acsard recording` lists the numbers"
            )
        return [Path(name)]
    where, files = _files(args)
    if name is not None:
        files = [path for path in files if number_of(path) == int(name)]
    if not files:
        which = "recording" if name is None else f"recording {name}"
        raise MendableError(f"no {which} in {where}; `acsard recording` lists the recordings")
    if args.begin is not None or args.end is not None:
        return [path for path in files if _may_overlap(path, *_range(args))] or files[-1:]
    if len(files) > 1:
        text = f"this is the newest of {len(files)} recordings; `acsard recording` lists all"
        print(f"{files[-1]}: {text}", file=sys.stderr)
    return files[-1:]


def _may_overlap(path: Path, begin_ns: WallNs, end_ns: WallNs) -> bool:
    try:
        head, status = first_head(path), path.stat()
    except OSError:
        return True  # the reader says why
    return head is None or _overlaps(head, status, begin_ns, end_ns)


def _overlaps(head: Head, status: os.stat_result, begin_ns: WallNs, end_ns: WallNs) -> bool:
    # If the file was written before it began, a copy has its time by another clock.
    last_ns = status.st_mtime_ns
    return head.wall_ns <= end_ns and (begin_ns <= last_ns or last_ns < head.wall_ns)


def _files(args: argparse.Namespace) -> tuple[Path, list[Path]]:
    where = Path(args.directory or load(None)[1].record.directory or SERVICE_DIRECTORY)
    try:
        return where, listed(where)
    except FileNotFoundError:
        raise MendableError(
            f"nothing is recorded in {where}: the directory does not exist. The service records "
            "automatically. Without the service, record with `acsard run --record DIRECTORY`, then "
            "name the same directory here with --directory DIRECTORY",
        ) from None
    except OSError as error:
        raise ExitError(
            Exit.NO_PERMISSION if isinstance(error, PermissionError) else Exit.FAILURE,
            f"cannot read {where}: {error.strerror}; name another directory with --directory, or "
            "use sudo",
        ) from None


def _new(args: argparse.Namespace, recording: Recording, ending: str) -> Path:
    # By default, write into the working directory, because the directory of the recordings may
    # belong to the service.
    new = Path(args.new or recording.paths[0].name.partition(".")[0] + ending)
    if new.suffix not in ("", ending):
        raise UsageError(
            f"{new} does not end with {ending}: a report ends with .html, and an export with "
            ".mcap, or with --csv with .csv"
        )
    return new


@contextmanager
def _written(new: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        code = Exit.NO_PERMISSION if isinstance(error, PermissionError) else Exit.FAILURE
        raise ExitError(code, f"cannot write {new}: {error.strerror}") from None


def _note_damage(recording: Recording) -> bool:
    for damage in recording.damage:
        print(printable(f"{damage}; that part is left out"), file=sys.stderr)
    return bool(recording.damage)


def _clock(wall_ns: WallNs) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(wall_ns // NS_PER_S))


class _ShownRecording(Recording):
    # Shows on a terminal the time of the step that is read.

    def records(self) -> Iterator[ReadRecord]:
        for number, record in enumerate(super().records()):
            if number % PROGRESS_RECORDS == 0 and isinstance(record, RecordedStep):
                at = _clock(record.now.wall_ns)
                print(f"\r{at}", end="", file=sys.stderr, flush=True)
            yield record
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def _with_progress(args: argparse.Namespace) -> Recording:
    kind = _ShownRecording if sys.stderr.isatty() else Recording
    return kind(_chosen(args), *_range(args))
