"""`acsard recording export`: write a recording as files that other programs open."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from acsard.cli import recording_span
from acsard.cli.common import load
from acsard.cli.recording_progress import telling
from acsard.host.errors import Exit, ExitError

if TYPE_CHECKING:
    from acsard.recording.export import Kind
    from acsard.recording.file import Recording

DESCRIPTION = """\
Write what the robot said then as a file for Foxglove, Lichtblick, PlotJuggler and `ros2 bag play`:
MCAP, with odom, tf, tf_static, joint_states, cmd_vel_out, cmd_vel_in of each source, diagnostics,
state and log as ROS 2 messages, and their definitions. With --config it is what the robot would
have said with other parameters.
"""


def add(inner: argparse._SubParsersAction[argparse.ArgumentParser]) -> argparse.ArgumentParser:
    """Declare the action and its options."""
    parser = inner.add_parser(
        "export",
        help="write it for Foxglove, PlotJuggler, ros2 bag or a table",
        description=DESCRIPTION,
    )
    parser.add_argument("file", nargs="?", metavar="FILE")
    parser.add_argument("new", nargs="?", metavar="NEW", help="what to write (by default in this "
                        "directory, called as the recording, with another ending)")  # fmt: skip
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--csv", dest="kind", action="store_const", const="csv", default="mcap",
                      help="write a table: a line for each feedback; what `acsard calibrate --log` "
                      "reads comes first")  # fmt: skip
    form.add_argument("--rosbag2", dest="kind", action="store_const", const="rosbag2",
                      help="write a directory with metadata.yaml, as `ros2 bag` does")  # fmt: skip
    parser.add_argument("--config", metavar="FILE", help="another acsard.toml in place of its own")
    parser.add_argument("--force", action="store_true", help="write over what is there")
    return parser


def export_one(recording: Recording, args: argparse.Namespace) -> str:
    """Write the file, print a summary, and return why it ends early, or "" if it is complete."""
    from acsard.recording.export import Span, export

    kind: Kind = args.kind
    new = Path(args.new) if args.new else _name(recording.path, kind)
    span = Span(*recording_span.span(args, recording))
    other = None if args.config is None else load(args.config)[1]
    try:
        with telling(recording) as tell:
            done = export(recording, new, kind, other, span, tell, args.force)
    except OSError as error:
        denied = isinstance(error, PermissionError)
        raise ExitError(
            Exit.NO_PERMISSION if denied else Exit.FAILURE, f"cannot write {new}: {error.strerror}"
        ) from None
    print(f"{done.count} {'rows' if kind == 'csv' else 'messages'} in {new}")
    return done.trouble


def _name(path: Path, kind: Kind) -> Path:
    """Return the default name of the file, in the current directory.

    The directory of the recordings belongs to the service.
    """
    from acsard.recording.export import SUFFIX

    return Path(path.name.partition(".")[0] + SUFFIX[kind])
