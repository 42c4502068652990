"""Work with the recordings that the daemon has made. Without a subcommand, list them, oldest
first, with the main events of each. `!` marks recordings with a stop, a fault or a crash. With
--from and --to, list only the recordings from the time between them. The argument FILE of a
subcommand is the file of a recording, or its number in the list. Without FILE, `show`, `replay`,
`export` and `report` use the newest recording. FILE of `show`, `export` and `report` can also be
`all`; without FILE, and if --from or --to is a date or a time of day, these three use all
recordings in that span.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

import msgspec

from acsard.cli.common import load
from acsard.core.config.settings import Config
from acsard.core.formatting import json_line, listed, many, printable
from acsard.core.values import NS_PER_S
from acsard.host.errors import Exit, ExitError, MendableError, RecordingError, UsageError
from acsard.recording.atomic_output import replacing
from acsard.recording.end_record import CRASH_CUTS, EndRecord, ending_text, read_end
from acsard.recording.export import SUFFIX, Kind, export
from acsard.recording.file_replay import config_of, replay_file, steps
from acsard.recording.html_report import report
from acsard.recording.mcap_directory import is_being_recorded
from acsard.recording.mcap_directory import listed as recordings_in
from acsard.recording.mcap_file import UNFINISHED, Recording, is_part, rewrite
from acsard.recording.published import published
from acsard.recording.replay_text import (
    describe_difference,
    describe_gaps,
    describe_outcome,
    explain_settings,
    explain_verdict,
    verdict,
)
from acsard.recording.series import NothingRecordedError, in_words, search
from acsard.recording.time_span import (
    ALL_EXAMPLES,
    TIME_EXAMPLES,
    WHOLE_SPAN,
    Offset,
    Span,
    TimeError,
    When,
    clock,
    date,
    parse_when,
    resolve,
    span,
)
from acsard.recording.timeline import TimelineEntry, TimelineWriter
from acsard.terminal.output import show, table

NOTHING_IN_SPAN = "no step of this recording is in that span of time; correct --from and --to"

MAX_NAMES = 10  # recordings, and gaps, that a search prints

SERVICE_DIRECTORY = Path("/var/lib/acsard/record")  # of the systemd service


EXPORT_DESCRIPTION = """\
Write the messages of a recorded robot as a file for Foxglove, Lichtblick, PlotJuggler and `ros2 bag
play`. The file is MCAP with odom, tf, tf_static, joint_states, cmd_vel_out, cmd_vel_in of each
source, diagnostics, state and log as ROS 2 messages, and with their definitions. With --config,
write the messages that the robot would have published with another configuration. A part that
cannot be read because of damage is left out. Exit codes: 0 complete, 65 a part is left out.
"""

REPORT_DESCRIPTION = """\
Draw a recording as one HTML file that needs no network. A part that cannot be read because of
damage is left out and named; the exit code stays 0.
"""


# Advice by output format and suffix of the typed file name.
_MISNAMED = {
    ("mcap", ".csv"): "add --csv to write a table, or let the name end in .mcap",
    ("csv", ".mcap"): "leave out --csv to write MCAP, or let the name end in .csv",
    ("csv", ".html"): "let the name end in .csv; `acsard recording report` writes HTML",
    ("rosbag2", ".csv"): "write --csv in place of --rosbag2 to get a table, or leave out .csv to "
    "get a directory",
    ("rosbag2", ".mcap"): "leave out --rosbag2 to write one MCAP file, or leave out .mcap to get a "
    "directory",
    ("html", ".csv"): "let the name end in .html; `acsard recording export --csv` writes a table",
    ("html", ".mcap"): "let the name end in .html; `acsard recording export` writes MCAP",
    ("html", ".txt"): "let the name end in .html; `acsard recording show` prints text",
}


def add_options(parser: argparse.ArgumentParser) -> None:
    _directory(parser, None)
    _own_config(parser, None)
    _times(parser, None, TIME_EXAMPLES)
    actions = parser.add_subparsers(title="subcommands", metavar="SUBCOMMAND")
    view = actions.add_parser(
        "show",
        help="print the events of a recording as text",
        description="Print the events of a recording as text, one line per event. A line `gap` "
        "shows where steps are missing, for example because the file is damaged; the exit code is "
        "still 0.",
    )
    view.add_argument("--json", action="store_true", help="print each event as a line of JSON")
    view.set_defaults(main=main_show)
    replay = actions.add_parser(
        "replay",
        help="run the recorded inputs through the program again, without a robot, and compare the "
        "results",
        description="Run the recorded inputs through the program again, without a robot, and "
        "compare the results with the recorded ones: each line to the board, and each pose, mode, "
        "reason and event. With --config, show what another configuration would have changed. A "
        "part that cannot be read because of damage is not compared. Exit codes: 0 everything is "
        "the same, 1 something differs, 65 a part was not compared and the rest is the same.",
    )
    replay.set_defaults(main=main_replay, must_finish=True)
    recover = actions.add_parser(
        "recover",
        help="write the intact part of an unfinished or damaged recording as a finished file",
        description="Write the intact part of an unfinished or damaged recording as a finished "
        "file. The recording itself is not changed.",
    )
    recover.add_argument(
        "file",
        metavar="FILE",
        help="file of the recording, or the recording's number in the list of `acsard recording`",
    )
    recover.add_argument("new", metavar="NEW", help="the file to write")
    recover.set_defaults(main=main_recover)
    exported = actions.add_parser(
        "export",
        help="convert a recording to a file for Foxglove, PlotJuggler or ros2 bag, or to a table",
        description=EXPORT_DESCRIPTION,
    )
    exported.set_defaults(main=main_export)
    drawn = actions.add_parser(
        "report",
        help="draw the robot's path and speeds, the command sources, the serial link and the "
        "events of a recording, as one HTML file",
        description=REPORT_DESCRIPTION,
    )
    drawn.set_defaults(main=main_report)
    number = "the recording's number in the list of `acsard recording`"
    file = f"file of a recording, or {number} (default: the newest recording)"
    default = "the newest recording, or all if --from or --to is a date or a time"
    several = f"file of a recording, {number}, or `all` (default: {default})"
    for action, words in ((view, several), (replay, file), (exported, several), (drawn, several)):
        action.add_argument("file", nargs="?", metavar="FILE", help=words)
    for action, name, default in (
        (
            exported,
            "NEW",
            "the recording's name with the new format's suffix, in the working directory",
        ),
        (drawn, "NEW.html", "FILE.html in the working directory"),
    ):
        words = f"file to write (default: {default})"
        action.add_argument("new", nargs="?", metavar=name, help=words)
    _export_forms(exported)
    for action in (replay, exported):
        action.add_argument(
            "--config",
            metavar="FILE",
            help="another acsard.toml to use instead of the recorded configuration",
        )
    for action in (recover, exported, drawn):
        action.add_argument("--force", action="store_true", help="overwrite an existing file")
    for action in (view, exported, drawn):
        _times(action, argparse.SUPPRESS, f"{ALL_EXAMPLES} (not with FILE `all`)")
    for action in (view, replay, recover, exported, drawn):
        _directory(action, argparse.SUPPRESS)
    # `replay` and `export` do not get this option. Their own option --config names a configuration
    # to try, and not the one that names the directory of the recordings.
    for action in (view, recover, drawn):
        _own_config(action, argparse.SUPPRESS)


def _export_forms(parser: argparse.ArgumentParser) -> None:
    form = parser.add_mutually_exclusive_group()
    form.add_argument(
        "--csv",
        dest="kind",
        action="store_const",
        const="csv",
        default="mcap",
        help="write a CSV table with one row per feedback line; its first columns are those that "
        "`acsard calibrate --log` reads",
    )
    form.add_argument(
        "--rosbag2",
        dest="kind",
        action="store_const",
        const="rosbag2",
        help="write a directory with metadata.yaml, as `ros2 bag` does",
    )


def _directory(parser: argparse.ArgumentParser, default: object) -> None:
    parser.add_argument(
        "--directory",
        default=default,
        metavar="DIRECTORY",
        help=f"directory of the recordings (default: record.directory, or {SERVICE_DIRECTORY})",
    )


def _times(parser: argparse.ArgumentParser, default: object, examples: str) -> None:
    for option, name in (("--from", "begin"), ("--to", "end")):
        parser.add_argument(
            option,
            dest=name,
            default=default,
            type=_when,
            metavar="TIME",
            help=f"for example {examples}",
        )


def _own_config(parser: argparse.ArgumentParser, default: object) -> None:
    parser.add_argument(
        "--config",
        dest="own_config",
        default=default,
        metavar="FILE",
        help="configuration file whose record.directory names the directory of the recordings "
        "(default: $ACSARD_CONFIG, ./acsard.toml, /etc/acsard/acsard.toml, or the built-in "
        "defaults)",
    )


def main(args: argparse.Namespace) -> int:
    first, last = _range(args)
    where, files = _files(args)
    rows: list[tuple[str, ...]] = []
    for path in files:
        try:
            end, note = read_end(path), ""
            if end is None:
                recording = Recording(path)
                end = recording.compute_end_record()
                fresh = is_being_recorded(path, time.time())
                note = "being recorded" if fresh else recording.missing_text
            begin_ns = end.wall_ns if end.earliest_ns is None else end.earliest_ns
            if begin_ns / NS_PER_S <= last and first <= end.last_ns / NS_PER_S:
                rows.append(_row(path, end, note))
        except FileNotFoundError:
            # The daemon has renamed or removed the file after it was listed.
            continue
        except RecordingError as error:
            rows.append((path.name, "", "", "", printable(str(error))))
    if rows:
        show(table(rows, right={2, 3}))
    else:
        words = f" {in_words(first, last)}" if files else ""
        mend = ": leave out --from and --to to list all recordings" if words else ""
        print(f"no recordings{words} in {where}{mend}")
    return Exit.OK


def _row(path: Path, end: EndRecord, note: str) -> tuple[str, ...]:
    began = clock(end.wall_ns / 1e9, day=True)
    seconds, size = (end.last_ns - end.wall_ns) / 1e9, path.stat().st_size / 1000
    mark = "! " if end.serious or end.cut in CRASH_CUTS else "  "
    text = end.said + _bracketed(ending_text(end.cut, end.why)) + _bracketed(note)
    return path.name, began, f"{seconds:.0f} s", f"{size:.0f} kB", mark + printable(text).strip()


def _bracketed(text: str) -> str:
    return f"  [{text}]" if text else ""


def main_show(args: argparse.Namespace) -> int:
    for recording, part in _parts(args):
        if not _show(recording, part, args.json) and part != WHOLE_SPAN:
            raise RecordingError(f"{recording.path}: {NOTHING_IN_SPAN}")
        note = recording.missing_text
        if _is_being_recorded(recording):
            note = note.replace(UNFINISHED, "being recorded")
        _note(recording, _bracketed(note))
    return Exit.OK


def _is_being_recorded(recording: Recording) -> bool:
    # Read all steps before: the ending is not known until then.
    if recording.ending != UNFINISHED:
        return False
    # The daemon may have renamed or removed the file in the meantime.
    with suppress(OSError):
        return is_being_recorded(recording.paths[-1], time.time())
    return False


def _show(recording: Recording, part: Span, as_json: bool) -> bool:
    # Returns False if `part` has no steps.
    story = TimelineWriter(_config_of(recording))
    has_steps, over = False, False
    for step in steps(recording):
        if over:
            # Read the remaining steps too, so that `recording.missing_text` covers the whole
            # recording.
            continue
        seconds = (step.inputs.now.mono_ns - recording.about.mono_ns) / NS_PER_S
        over = seconds > part.end
        entries = list(story.end() if over and has_steps else story.step(step))
        if part.begin <= seconds <= part.end or (over and has_steps):
            has_steps = True
            for entry in entries:
                _print_entry(entry, as_json)
    if over or (part.begin > 0.0 and not has_steps):
        return has_steps
    for entry in story.end("" if _is_being_recorded(recording) else recording.ending):
        _print_entry(entry, as_json)
    return has_steps


def _config_of(recording: Recording) -> Config | None:
    try:
        return config_of(recording)
    except RecordingError:
        return None


def _note(recording: Recording, note: str) -> None:
    if note:
        print(f"{recording.path}: {note.strip()}", file=sys.stderr)


def _print_entry(entry: TimelineEntry, as_json: bool) -> None:
    if as_json:
        print(json_line(msgspec.json.encode(entry).decode()))
    else:
        mark = {"warning": "! ", "error": "!! "}.get(entry.level, "")
        at = f"{date(entry.seconds)} {clock(entry.seconds)}"
        words = f"{at}  {mark}{entry.name.replace('_', ' ')}: {entry.sentence}"
        print(printable(words))


def main_replay(args: argparse.Namespace) -> int:
    """Replay a recording, print how the results differ, and return the exit code.

    It is 1 if they differ without --config, otherwise 65 if a part was not compared.
    """
    _require_one(args, "replay")
    recording = _recording(args)
    other = None if args.config is None else load(args.config)[1]
    with _progress(recording) as tell:
        result = replay_file(recording, other, tell)
    comparison = result.comparison
    print(f"{verdict(comparison)}\n{explain_verdict(other is not None)}")
    began_ns, rows = recording.about.mono_ns, list[str]()
    if other is not None:
        rows = explain_settings(config_of(recording), other, comparison, began_ns)
    if comparison.first is not None:
        difference = describe_difference(comparison.first, began_ns)
        rows = [*difference, *rows, *describe_outcome(comparison)]
    rows += filter(None, [result.event_copies, result.failed_step])
    for row in rows:
        print(printable(row))
    left_out = describe_gaps(result.gaps, "not compared")
    _note(recording, left_out)
    _note(recording, _bracketed(recording.missing_text))
    if not result.same and other is None:
        return Exit.FAILURE
    return Exit.INCOMPLETE if left_out else Exit.OK


def main_recover(args: argparse.Namespace) -> int:
    _require_one(args, "recover")
    recording, new = _recording(args), Path(args.new)
    replaces = ""

    def is_earlier_result(old: Recording) -> bool:
        nonlocal replaces
        if new.samefile(recording.path) or not is_part(old, recording):
            return False
        replaces = ", which replaces an earlier copy of the same recording"
        return True

    try:
        with replacing(new, args.force, is_earlier_result) as part:
            count = rewrite(recording, part)
    except OSError as error:
        raise MendableError(f"cannot write {new}: {error.strerror}") from None
    print(f"{many(count, 'message')} in {new}{replaces}{_bracketed(recording.missing_text)}")
    return Exit.OK


def main_export(args: argparse.Namespace) -> int:
    kind: Kind = args.kind
    _require_suffix(args.new, kind)
    parts, code = _files_to_write(args), Exit.OK
    other = None if args.config is None else load(args.config)[1]
    for recording, part in parts:
        # By default, write into the working directory, because the directory of the recordings may
        # belong to the service.
        new = Path(args.new or recording.path.name.partition(".")[0] + SUFFIX[kind])
        with _written(new), _progress(recording) as tell:
            done = export(recording, new, kind, other, part, tell, args.force)
        print(f"{done.count} {'rows' if kind == 'csv' else 'messages'} in {new}")
        left_out = describe_gaps(done.gaps, "not exported")
        _note(recording, left_out)
        _note(recording, _bracketed(recording.missing_text))
        if left_out:
            code = Exit.INCOMPLETE
    return code


def main_report(args: argparse.Namespace) -> int:
    _require_suffix(args.new, "html")
    for recording, part in _files_to_write(args):
        new = Path(args.new or f"{recording.path.name.partition('.')[0]}.html")
        with _written(new), replacing(new, args.force) as file, _progress(recording) as tell:
            messages = list(published(recording, part, tell))
            if not messages:
                raise RecordingError(f"{recording.path}: {NOTHING_IN_SPAN}")
            notes = [recording.missing_text] if recording.missing_text else []
            text = report(messages, recording.about.robot, notes)
            file.write_text(text, encoding="utf-8")
        print(f"{new}: {len(text) / 1e6:.1f} MB; open it in any browser")
        _note(recording, _bracketed(recording.missing_text))
    return Exit.OK


def _require_one(args: argparse.Namespace, subcommand: str) -> None:
    if args.begin is not None or args.end is not None or args.file == "all":
        new = " NEW" if subcommand == "recover" else ""
        raise UsageError(
            f"{subcommand} takes one whole recording: leave out --from and --to, and write its "
            f"file or number, not `all`, as in `acsard recording {subcommand} 12{new}`; `acsard "
            "recording` lists the numbers"
        )


def _require_suffix(new: str | None, kind: Kind | Literal["html"]) -> None:
    suffix = Path(new or "").suffix.lower()
    if mend := _MISNAMED.get((kind, suffix)):
        form = "a directory" if kind == "rosbag2" else f"{kind.upper()}, not {suffix}"
        raise UsageError(f"nothing is written to {new}, because the output is {form}: {mend}")


def _files_to_write(args: argparse.Namespace) -> list[tuple[Recording, Span]]:
    parts = _parts(args)
    if args.new is not None and len(parts) > 1:
        raise UsageError(
            f"this recording has {len(parts)} separate parts, because the daemon restarted or "
            "steps are missing, and acsard writes each part into its own file: either leave out "
            "the argument NEW, or choose a shorter span of time with --from and --to"
        )
    return parts


def _parts(args: argparse.Namespace) -> list[tuple[Recording, Span]]:
    times = [when for when in (args.begin, args.end) if when is not None]
    by_clock = bool(times) and not any(isinstance(when, Offset) for when in times)
    if args.file == "all" or (args.file is None and by_clock):
        return _search(args)
    recording = _recording(args)
    if args.file is None and times:
        _note(
            recording, "the seconds of --from and --to count from the beginning of this recording"
        )
    return [(recording, span(recording, args.begin, args.end))]


def _range(args: argparse.Namespace) -> tuple[float, float]:
    # s since 1970; -inf and inf without these options.
    if any(isinstance(when, Offset) for when in (args.begin, args.end)):
        raise UsageError(
            "--from and --to in seconds count from the beginning of one recording, but "
            "`acsard recording` and FILE `all` search all recordings: either name one recording, "
            f"as in `acsard recording show 12 --from 30`, or write a time, for example "
            f"{TIME_EXAMPLES}"
        )
    try:
        return resolve(args.begin, args.end, time.time())
    except TimeError as error:
        raise UsageError(str(error)) from None


def _search(args: argparse.Namespace) -> list[tuple[Recording, Span]]:
    first, last = _range(args)
    where, files = _files(args)
    try:
        with _search_progress(len(files)) as tell:
            result = search(files, first, last, tell)
    except NothingRecordedError as error:
        raise RecordingError(
            f"{error} (searched {many(len(files), 'recording')} in {where})"
        ) from None
    names = [path.name for hit in result.found for path in hit.recording.paths]
    looked = f"{len(names)} of {many(len(files), 'recording')} in {where}"
    print(f"{in_words(first, last)}: {looked}: {listed(names, MAX_NAMES)}", file=sys.stderr)
    if result.gaps:
        gaps = listed([in_words(*gap) for gap in result.gaps], MAX_NAMES, "; ")
        print(f"nothing was recorded {gaps}", file=sys.stderr)
    for sentence in result.unreadable:
        print(printable(sentence), file=sys.stderr)
    return [(hit.recording, hit.part) for hit in result.found]


def _files(args: argparse.Namespace) -> tuple[Path, list[Path]]:
    where = Path(args.directory or load(args.own_config)[1].record.directory or SERVICE_DIRECTORY)
    try:
        return where, recordings_in(where)
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


def _recording(args: argparse.Namespace) -> Recording:
    name = args.file
    if name is not None and not re.fullmatch(r"\d{1,9}", name):
        return Recording(Path(name))
    where, files = _files(args)
    if name is not None:
        files = [path for path in files if int(path.name.partition("-")[0]) == int(name)]
    if not files:
        which = "recording" if name is None else f"recording {name}"
        raise MendableError(f"no {which} in {where}; `acsard recording` lists the recordings")
    recording = Recording(files[-1])
    if name is None and len(files) > 1:
        _note(
            recording,
            f"this is the newest of {len(files)} recordings; `acsard recording` lists all",
        )
    return recording


def _when(text: str) -> When:
    try:
        return parse_when(text, time.time())
    except TimeError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


@contextmanager
def _progress(recording: Recording) -> Iterator[Callable[[int], None]]:
    # Shows on a terminal the time of the last step that was read.
    began_ns = recording.about.wall_ns
    last = read_end(recording.paths[-1]) if sys.stderr.isatty() else None
    whole = f" of {(last.last_ns - began_ns) / 1e9:.0f}" if last else ""
    with _overwritten_line() as show_line:
        yield lambda wall_ns: show_line(
            f"{(wall_ns - began_ns) / 1e9:.0f}{whole} s of the recording"
        )


@contextmanager
def _search_progress(count: int) -> Iterator[Callable[[int], None]]:
    # Shows on a terminal the files that have been searched.
    with _overwritten_line() as show_line:
        yield lambda searched: show_line(f"searched {searched} of {many(count, 'recording')}")


@contextmanager
def _overwritten_line() -> Iterator[Callable[[str], None]]:
    # In the place of the terminal's last line, which is cleared at the end.
    if not sys.stderr.isatty():
        yield lambda text: None
        return
    try:
        yield lambda text: print(f"\r{text}", end="", file=sys.stderr, flush=True)
    finally:
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


@contextmanager
def _written(new: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        code = Exit.NO_PERMISSION if isinstance(error, PermissionError) else Exit.FAILURE
        raise ExitError(code, f"cannot write {new}: {error.strerror}") from None
