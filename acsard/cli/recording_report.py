"""`acsard recording report`: draw a recording as one HTML file."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from acsard.cli import recording_span
from acsard.cli.recording_progress import telling
from acsard.core.values import NS_PER_S
from acsard.host.errors import Exit, ExitError
from acsard.host.extras import install

if TYPE_CHECKING:
    from acsard.recording.file import Recording

DESCRIPTION = """\
Draw a recording as one HTML file that needs no network. Needs the library plotly; if it is missing,
a message gives the command that installs it.
"""


class Words(NamedTuple):
    """Functions that the actions of `acsard recording` share to format times and recordings."""

    clock: Callable[[float, bool], str]
    state: Callable[[Recording], str]
    """Function that returns the missing parts of a recording that has been read."""


def add(inner: argparse._SubParsersAction[argparse.ArgumentParser]) -> argparse.ArgumentParser:
    """Declare the action and its options."""
    parser = inner.add_parser(
        "report",
        help="draw a recording as one HTML file with path, speeds, sources, link and events",
        description=DESCRIPTION,
    )
    parser.add_argument("file", nargs="?", metavar="FILE", help=recording_span.FILE_HELP)
    parser.add_argument(
        "new",
        nargs="?",
        metavar="NEW.html",
        help="file to write (default: FILE.html in this directory)",
    )
    parser.add_argument("--force", action="store_true", help="overwrite an existing file")
    parser.add_argument("--supervised", action="store_true", help=argparse.SUPPRESS)
    return parser


def library() -> str:
    """Return plotly's script.

    Raises `ExitError` with the command to install it if it is missing.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        message = f"needs the library plotly; run: {install('report')}"
        raise ExitError(Exit.FAILURE, message) from None
    script: str = get_plotlyjs()
    return script


def report_one(
    recording: Recording, args: argparse.Namespace, plotly: str, words: Words
) -> list[str]:
    """Write the report, print a summary, and return notes about the recording."""
    from acsard.recording.atomic_output import replacing

    if args.supervised:
        return _held(recording, args, plotly, words)
    new = Path(args.new or f"{recording.path.name.partition('.')[0]}.html")
    try:
        with replacing(new, args.force) as part, telling(recording) as tell:
            text, known = _drawn(recording, args, plotly, words, tell)
            part.write_text(text, encoding="utf-8")
    except OSError as error:
        denied = isinstance(error, PermissionError)
        raise ExitError(
            Exit.NO_PERMISSION if denied else Exit.FAILURE, f"cannot write {new}: {error.strerror}"
        ) from None
    print(f"{new}: {len(text) / 1e6:.1f} MB; open it in any browser")
    return known


def _held(recording: Recording, args: argparse.Namespace, plotly: str, words: Words) -> list[str]:
    """Write the report to standard output for the page's server.

    The progress in percent goes to standard error.
    """
    from acsard.host.child import end_with_parent
    from acsard.recording.end_record import read_end

    end_with_parent(signal.SIGKILL)
    last, began = read_end(recording.path), recording.about.wall_ns / 1e9
    end = last.last_ns / 1e9 if last else recording.path.stat().st_mtime
    told = 0

    def tell(at_ns: int) -> None:
        nonlocal told
        percent = int(100 * (at_ns / 1e9 - began) / max(1.0, end - began))
        if told < percent < 100:
            told = percent
            print(percent, file=sys.stderr, flush=True)

    text, _ = _drawn(recording, args, plotly, words, tell)
    sys.stdout.buffer.write(text.encode())
    return []


def _drawn(
    recording: Recording,
    args: argparse.Namespace,
    plotly: str,
    words: Words,
    tell: Callable[[int], None],
) -> tuple[str, list[str]]:
    """Return the HTML text and notes about the recording.

    `tell` is called with the wall-clock time reached, in ns.
    """
    from acsard.recording.file_replay import PROGRESS_STEPS, DisplayReplay
    from acsard.recording.replay_text import verdict
    from acsard.report.page import page
    from acsard.report.report_data import ReportData
    from acsard.report.report_text import Origin, notes

    about, replayed = recording.about, DisplayReplay(recording)
    began, (begin, end) = about.wall_ns / NS_PER_S, recording_span.span(args, recording)
    data = ReportData(replayed.config, began + begin, began + end)
    for number, (step, outputs, robot) in enumerate(replayed.steps()):
        if number % PROGRESS_STEPS == 0:
            tell(step.inputs.now.wall_ns)
        data.step(step, outputs, robot)
        if data.over:
            # Read the rest, so that the notes count every damaged place.
            deque(recording.messages(), maxlen=0)
            break
    if data.began is None:
        message = f"{recording.path} has no step in that span of time, so there is nothing to draw"
        raise ExitError(Exit.FAILURE, message)
    data.end()
    remarks = [*filter(None, [words.state(recording).strip(" []")]), *replayed.notes]
    comparison = replayed.replay.comparison
    if not (comparison.same or replayed.notes or data.missing):
        remarks.append(
            "this version of acsard computes other results than the recorded ones: "
            f"{verdict(comparison)}"
        )
    origin = Origin(recording.path.name, about.robot, about.version, about.python, tuple(remarks))
    offset_s = time.localtime(data.began).tm_gmtoff
    return page(data, origin, plotly, words.clock, offset_s), notes(data, origin)
