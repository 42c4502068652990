"""`acsard recording export`: write a recording as files that other programs open."""

from __future__ import annotations

import argparse
from pathlib import Path

from acsard.cli import recording_span
from acsard.cli.common import load
from acsard.cli.recording_progress import telling
from acsard.host.errors import Exit, ExitError
from acsard.recording.export import SUFFIX, Kind, Span, export
from acsard.recording.file import Recording

DESCRIPTION = """\
Write the messages of a recorded robot as a file for Foxglove, Lichtblick, PlotJuggler and `ros2 bag
play`. The file is MCAP with odom, tf, tf_static, joint_states, cmd_vel_out, cmd_vel_in of each
source, diagnostics, state and log as ROS 2 messages, and with their definitions. With --config,
write the messages that the robot would have published with another configuration.
"""


def add(inner: argparse._SubParsersAction[argparse.ArgumentParser]) -> argparse.ArgumentParser:
    """Declare the action and its options."""
    parser = inner.add_parser(
        "export",
        help="write a recording as a file for Foxglove, PlotJuggler, ros2 bag, or as a table",
        description=DESCRIPTION,
    )
    parser.add_argument("file", nargs="?", metavar="FILE", help=recording_span.FILE_HELP)
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
    parser.add_argument(
        "--config",
        metavar="FILE",
        help="another acsard.toml to use instead of the recorded configuration",
    )
    parser.add_argument("--force", action="store_true", help="overwrite an existing file")
    return parser


def export_one(recording: Recording, args: argparse.Namespace) -> str:
    """Write the file, print a summary, and return why it ends early, or "" if it is complete."""
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
    return Path(path.name.partition(".")[0] + SUFFIX[kind])
