"""The actions of `acsard recording` that write files for other programs, and their progress."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from acsard.cli.common import load
from acsard.host.child import end_with_parent
from acsard.host.errors import Exit, ExitError
from acsard.host.extras import missing
from acsard.recording import export as exports
from acsard.recording.atomic_output import replacing
from acsard.recording.end_record import read_end
from acsard.recording.file import Recording
from acsard.recording.replay_text import describe_gaps
from acsard.recording.time_span import Span
from acsard.report.page import drawn

EXPORT = """\
Write the messages of a recorded robot as a file for Foxglove, Lichtblick, PlotJuggler and `ros2 bag
play`. The file is MCAP with odom, tf, tf_static, joint_states, cmd_vel_out, cmd_vel_in of each
source, diagnostics, state and log as ROS 2 messages, and with their definitions. With --config,
write the messages that the robot would have published with another configuration. A part that a
damaged place makes unreadable is left out. Exit codes: 0 complete, 65 a part is left out.
"""

REPORT = """\
Draw a recording as one HTML file that needs no network. Needs the library plotly; if it is missing,
a message gives the command that installs it. A part that a damaged place makes unreadable is left
out and named; the exit code stays 0.
"""


@contextmanager
def progress(recording: Recording) -> Iterator[Callable[[int], None]]:
    """Yield a function that shows the progress; call it with the wall-clock time reached, in ns.

    The progress line is erased at the end. If standard error is not a terminal, nothing is shown.
    """
    if not sys.stderr.isatty():
        yield lambda wall_ns: None
        return
    began_ns, last = recording.about.wall_ns, read_end(recording.paths[-1])
    whole = f" of {(last.last_ns - began_ns) / 1e9:.0f}" if last else ""

    def tell(wall_ns: int) -> None:
        text = f"\r{(wall_ns - began_ns) / 1e9:.0f}{whole} s"
        print(text, end="", file=sys.stderr, flush=True)

    try:
        yield tell
    finally:
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


@contextmanager
def _written(new: Path) -> Iterator[None]:
    """Turn the error of a file that cannot be written into one with an exit code."""
    try:
        yield
    except OSError as error:
        code = Exit.NO_PERMISSION if isinstance(error, PermissionError) else Exit.FAILURE
        raise ExitError(code, f"cannot write {new}: {error.strerror}") from None


def add_export(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "new",
        nargs="?",
        metavar="NEW",
        help="file to write (default: the recording's name with another suffix, in this directory)",
    )
    form = parser.add_mutually_exclusive_group()
    form.add_argument(
        "--csv",
        dest="kind",
        action="store_const",
        const="csv",
        default="mcap",
        help="write a table with one row per feedback line; its first columns are those that "
        "`acsard calibrate --log` reads",
    )
    form.add_argument(
        "--rosbag2",
        dest="kind",
        action="store_const",
        const="rosbag2",
        help="write a directory with metadata.yaml, as `ros2 bag` does",
    )


def export(recording: Recording, part: Span, args: argparse.Namespace) -> str:
    """Write a part of the recording, print a summary, and say which steps are missing in it.

    Returns "" if no step is missing.
    """
    kind: exports.Kind = args.kind
    # The default is this directory, because that of the recordings belongs to the service.
    new = Path(args.new or recording.path.name.partition(".")[0] + exports.SUFFIX[kind])
    other = None if args.config is None else load(args.config)[1]
    with _written(new), progress(recording) as tell:
        done = exports.export(recording, new, kind, other, part, tell, args.force)
    print(f"{done.count} {'rows' if kind == 'csv' else 'messages'} in {new}")
    return describe_gaps(done.gaps, "not exported")


def add_report(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "new",
        nargs="?",
        metavar="NEW.html",
        help="file to write (default: FILE.html in this directory)",
    )
    parser.add_argument("--supervised", action="store_true", help=argparse.SUPPRESS)


def library() -> str:
    """Return plotly's script; raise `MendableError` with the command that installs it."""
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise missing("plotly", "report") from None
    script: str = get_plotlyjs()
    return script


def report(recording: Recording, part: Span, args: argparse.Namespace, plotly: str) -> list[str]:
    """Write the report of a part, print a summary, and return notes about the recording."""
    if args.supervised:
        end_with_parent(signal.SIGKILL)
        text, _ = drawn(recording, plotly, part, _percent(recording))
        sys.stdout.buffer.write(text.encode())
        return []
    new = Path(args.new or f"{recording.path.name.partition('.')[0]}.html")
    with _written(new), replacing(new, args.force) as file, progress(recording) as tell:
        text, notes = drawn(recording, plotly, part, tell)
        file.write_text(text, encoding="utf-8")
    print(f"{new}: {len(text) / 1e6:.1f} MB; open it in any browser")
    return notes


def _percent(recording: Recording) -> Callable[[int], None]:
    """Return a function that writes the progress in percent to standard error.

    The page's server reads it.
    """
    last, began = read_end(recording.path), recording.about.wall_ns / 1e9
    end = last.last_ns / 1e9 if last else recording.path.stat().st_mtime
    told = 0

    def tell(at_ns: int) -> None:
        nonlocal told
        percent = int(100 * (at_ns / 1e9 - began) / max(1.0, end - began))
        if told < percent < 100:
            told = percent
            print(percent, file=sys.stderr, flush=True)

    return tell
