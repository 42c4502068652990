"""`acsard recording`: list, show, replay and export the recordings of the black box."""

from __future__ import annotations

import argparse
import re
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from acsard.cli import recording_export, recording_report, recording_span
from acsard.cli.common import load
from acsard.cli.recording_progress import telling
from acsard.core.formatting import json_line, many, printable
from acsard.host.errors import Exit, ExitError

if TYPE_CHECKING:
    from acsard.recording.end_record import EndRecord
    from acsard.recording.file import Recording
    from acsard.recording.timeline import TimelineEntry

SERVICE = Path("/var/lib/acsard/record")
"""The directory in which the service records."""

DESCRIPTION = """\
Work with the recordings that the daemon has made. Without a verb, list them, oldest first, with the
main events of each. FILE is a recording or its number in that list (default: the newest recording).
"""


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the verb, its actions and their options."""
    parser = verbs.add_parser("recording", help="list, show, replay, export and draw recordings",
                              description=DESCRIPTION)  # fmt: skip
    _directory(parser, None)
    parser.set_defaults(main=list_all)
    inner = parser.add_subparsers(title="verbs", metavar="VERB")
    show = inner.add_parser(
        "show",
        help="print the events of a recording as text",
        description="Print the events of a recording as text, one line per event.",
    )
    show.add_argument("file", nargs="?", metavar="FILE", help=recording_span.FILE_HELP)
    recording_span.add(show)
    show.add_argument("--json", action="store_true", help="print one JSON object a line")
    show.set_defaults(main=show_one)
    replay = inner.add_parser(
        "replay",
        help="run the recorded inputs through the robot again and compare the results",
        description="Run the recorded inputs through the robot again, and compare every line, "
        "mode and pose with the recorded ones. With --config, show what another "
        "configuration would have changed.",
    )
    replay.add_argument("file", nargs="?", metavar="FILE", help=recording_span.FILE_HELP)
    replay.add_argument(
        "--config",
        metavar="FILE",
        help="another acsard.toml to use instead of the recorded configuration",
    )
    replay.set_defaults(main=replay_one)
    recover = inner.add_parser(
        "recover",
        help="write the intact part of an unfinished or damaged recording as a finished file",
        description="Write the intact part of an unfinished or damaged recording as a finished "
        "file. The recording itself is not changed.",
    )
    recover.add_argument("file", metavar="FILE", help="the recording, or its number in the list")
    recover.add_argument("new", metavar="NEW", help="the file to write")
    recover.add_argument("--force", action="store_true", help="overwrite an existing file")
    recover.set_defaults(main=recover_one)
    export = recording_export.add(inner)
    recording_span.add(export)
    export.set_defaults(main=export_one)
    report = recording_report.add(inner)
    recording_span.add(report)
    report.set_defaults(main=report_one)
    for one in (show, replay, recover, export, report):
        _directory(one, argparse.SUPPRESS)


def _directory(parser: argparse.ArgumentParser, default: object) -> None:
    parser.add_argument(
        "--directory",
        default=default,
        metavar="DIRECTORY",
        help=f"directory of the recordings (default: record.directory, or {SERVICE})",
    )


def list_all(args: argparse.Namespace) -> int:
    """Print a line for each recording."""
    from acsard.host.errors import RecordingError
    from acsard.recording.end_record import read_end
    from acsard.recording.file import Recording
    from acsard.terminal.output import show
    from acsard.terminal.tables import table

    where, files = _files(args)
    if not files:
        print(f"no recordings in {where}")
    rows: list[tuple[str, ...]] = []
    for path in files:
        try:
            last = read_end(path)
            rows.append(_row(path, last) if last else _row_of_all(Recording(path)))
        except RecordingError as error:
            rows.append((path.name, "", "", "", printable(str(error))))
    if rows:
        show(table(rows, right={2, 3}))
    return int(Exit.OK)


def _row(path: Path, last: EndRecord, note: str = "") -> tuple[str, ...]:
    from acsard.recording.end_record import how_it_ends

    began = _clock(last.wall_ns / 1e9, day=True)
    seconds, size = (last.last_ns - last.wall_ns) / 1e9, path.stat().st_size / 1000
    said = last.said + _bracketed(how_it_ends(last.cut, last.why)) + note
    return path.name, began, f"{seconds:.0f} s", f"{size:.0f} kB", printable(said).strip()


def _row_of_all(recording: Recording) -> tuple[str, ...]:
    """Return the row of a recording without an end. The whole recording must be read for it."""
    from acsard.host.errors import RecordingError
    from acsard.recording.file import EndRecordBuilder, event_of

    builder = EndRecordBuilder(recording.about)
    for topic, wall_ns, data in recording.messages():
        builder.message(topic, wall_ns, data)
        if topic == "events":
            with suppress(RecordingError):  # omit only the event that cannot be decoded
                builder.event(event_of(recording, data))
    return _row(recording.path, builder.end_record(), _state(recording))


def _bracketed(text: str) -> str:
    return f"  [{text}]" if text else ""


def _state(recording: Recording) -> str:
    """Describe the missing parts of a recording, once it has been read completely."""
    places = many(recording.damaged, "damaged place is", "damaged places are")
    damaged = f"{places} left out" if recording.damaged else ""
    return _bracketed("; ".join(filter(None, [damaged, _ending(recording)])))


def _ending(recording: Recording) -> str:
    """Return why the recording ended other than by a normal end of the daemon, or ""."""
    from acsard.recording.end_record import how_it_ends

    if not recording.ended:
        return "no end: cut off, or still being recorded"
    return how_it_ends(recording.cut, recording.why)


def show_one(args: argparse.Namespace) -> int:
    """Print the timeline of a recording."""
    from acsard.recording.file_replay import steps
    from acsard.recording.timeline import TimelineEntry, TimelineWriter

    recording = _recording(args)
    begin, end = recording_span.span(args, recording)
    story, last = TimelineWriter(), recording.about.wall_ns / 1e9
    inside = begin <= 0.0
    for step in steps(recording):
        now = step.inputs.now
        seconds, last = (now.mono_ns - recording.about.mono_ns) / 1e9, now.wall_ns / 1e9
        inside = begin <= seconds <= end
        for one in story.step(step):
            if inside:
                _tell(one, args.json)
    ending = _ending(recording)
    if ending and inside:
        _tell(TimelineEntry(last, "cut", ending.removeprefix("cut: "), "warning"), args.json)
    note = _state(recording)
    if note:
        print(f"{recording.path}:{note}", file=sys.stderr)
    return int(Exit.OK)


def _tell(one: TimelineEntry, as_json: bool) -> None:
    import msgspec

    if as_json:
        print(json_line(msgspec.json.encode(one).decode()))
    else:
        print(printable(_sentence(one)))


def replay_one(args: argparse.Namespace) -> int:
    """Replay a recording and compare the result with the recorded one.

    Returns 1 if they differ; with --config a difference is expected and it returns 0.
    """
    from acsard.recording.file_replay import config_of, replay_file
    from acsard.recording.replay_text import (
        describe_difference,
        describe_outcome,
        explain_settings,
        explain_verdict,
        verdict,
    )

    recording = _recording(args)
    other = None if args.config is None else load(args.config)[1]
    with telling(recording) as tell:
        comparison, trouble, failed_step = replay_file(recording, other, tell)
    print(f"{verdict(comparison)}\n{explain_verdict(other is not None)}")
    began_ns, rows = recording.about.mono_ns, list[str]()
    if other is not None:
        rows = explain_settings(config_of(recording), other, comparison, began_ns)
    if comparison.first is not None:
        difference = describe_difference(comparison.first, began_ns)
        rows = [*difference, *rows, *describe_outcome(comparison)]
    rows += [failed_step] if failed_step else []
    for row in rows:
        print(printable(row))
    note = trouble or _state(recording).strip()
    if note:
        print(f"{recording.path}: {note}", file=sys.stderr)
    return int(Exit.OK if comparison.same or other is not None else Exit.FAILURE)


def recover_one(args: argparse.Namespace) -> int:
    """Rewrite an unfinished or damaged recording as a finished file."""
    from acsard.recording.atomic_output import replacing
    from acsard.recording.file import rewrite

    recording, new = _recording(args), Path(args.new)
    try:
        with replacing(new, args.force) as part:
            count = rewrite(recording, part)
    except OSError as error:
        raise ExitError(Exit.FAILURE, f"cannot write {new}: {error.strerror}") from None
    print(f"{many(count, 'message')} in {new}{_state(recording)}")
    return int(Exit.OK)


def export_one(args: argparse.Namespace) -> int:
    """Export a recording for other programs."""
    recording = _recording(args)
    trouble = recording_export.export_one(recording, args)
    note = trouble or _state(recording).strip()
    if note:
        print(f"{recording.path}: {note}", file=sys.stderr)
    return int(Exit.OK)


def report_one(args: argparse.Namespace) -> int:
    """Draw a recording as an HTML file."""
    plotly = recording_report.library()
    recording = _recording(args)
    notes = recording_report.report_one(
        recording, args, plotly, recording_report.Words(_clock, _state)
    )
    for note in notes:
        print(f"{recording.path}: {note}", file=sys.stderr)
    return int(Exit.OK)


def _files(args: argparse.Namespace) -> tuple[Path, list[Path]]:
    from acsard.recording.directory import listed

    where = Path(args.directory or load(None)[1].record.directory or SERVICE)
    try:
        return where, listed(where)
    except FileNotFoundError:
        raise ExitError(
            Exit.FAILURE,
            f"nothing is recorded in {where}: the directory does not exist. The service records "
            "by itself; `acsard run --record DIRECTORY` records where you say. --directory "
            "reads another directory",
        ) from None
    except OSError as error:
        raise ExitError(
            Exit.NO_PERMISSION if isinstance(error, PermissionError) else Exit.FAILURE,
            f"cannot read {where}: {error.strerror}; name another directory with --directory, or "
            "use sudo",
        ) from None


def _recording(args: argparse.Namespace) -> Recording:
    from acsard.recording.file import Recording

    name = args.file
    if name is not None and not re.fullmatch(r"\d{1,9}", name):
        return Recording(Path(name))
    where, files = _files(args)
    if name is not None:
        files = [path for path in files if int(path.name.partition("-")[0]) == int(name)]
    if not files:
        which = "recording" if name is None else f"recording {name}"
        raise ExitError(Exit.FAILURE, f"no {which} in {where}; `acsard recording` lists them")
    return Recording(files[-1])


def _sentence(one: TimelineEntry) -> str:
    from acsard.core.ros.shapes import how_often

    by = f" (by {one.by})" if one.by else ""
    times = how_often(one.text, one.count)
    mark = {"warning": "! ", "error": "!! "}.get(one.level, "")
    return f"{_clock(one.seconds)}  {mark}{one.name.replace('_', ' ')}: {one.text}{by}{times}"


def _clock(seconds: float, day: bool = False) -> str:
    local = time.localtime(seconds)
    if day:
        return time.strftime("%Y-%m-%d %H:%M:%S", local)
    return time.strftime("%H:%M:%S", local) + f".{int(seconds % 1 * 1000):03}"
