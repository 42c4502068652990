"""`acsard log report`: a recording drawn as one HTML file."""

from __future__ import annotations

import argparse
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from acsard.cli.log_progress import telling
from acsard.host.exits import Exit, ExitError
from acsard.host.extras import install

if TYPE_CHECKING:
    from acsard.record.again import Onlooker
    from acsard.record.file import Recording
    from acsard.report.course import Course

DESCRIPTION = """\
Draw what happened as one HTML file that needs no network. Needs the library plotly; without it, it
tells what to type.
"""


class Words(NamedTuple):
    """How the verbs of `acsard log` read and tell."""

    seconds: Callable[[str | None], float | None]
    """Wall-clock time of --from or --to."""
    clock: Callable[[float, bool], str]
    state: Callable[[Recording], str]
    """What is missing of a recording, once it has been read."""


def add(inner: argparse._SubParsersAction[argparse.ArgumentParser]) -> argparse.ArgumentParser:
    """Declare the verb."""
    parser = inner.add_parser(
        "report",
        help="draw it: one HTML file with path, speeds, who drove and why, link, events",
        description=DESCRIPTION,
    )
    parser.add_argument("file", nargs="?", metavar="FILE")
    parser.add_argument("new", nargs="?", metavar="NEW.html", help="else FILE.html, here")
    parser.add_argument("--force", action="store_true", help="write over what is there")
    return parser


def library() -> str:
    """The script that draws; raises `ExitError` with what to type where it is missing."""
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
    """Write it, tell what was written, and return what is to be known of it."""
    from acsard.record.again import Onlooker, verdict
    from acsard.record.beside import beside
    from acsard.report.account import Origin, notes
    from acsard.report.course import Course
    from acsard.report.page import page

    new = Path(args.new or f"{recording.path.name.partition('.')[0]}.html")
    about, looked = recording.about, Onlooker(recording)
    course = Course(looked.config, words.seconds(args.begin), words.seconds(args.end))
    try:
        with beside(new, args.force) as part, telling(recording) as tell:
            _follow(recording, looked, course, tell)
            if course.began is None:
                message = f"{recording.path} has no step of that time to draw"
                raise ExitError(Exit.FAILURE, message)
            course.end()
            said = [*filter(None, [words.state(recording).strip(" []")]), *looked.notes]
            tally = looked.replay.tally
            if not (tally.same or looked.notes or course.missing):
                said.append(f"this acsard computes it otherwise than it was: {verdict(tally)}")
            origin = Origin(
                recording.path.name, about.robot, about.version, about.python, tuple(said)
            )
            offset_s = time.localtime(course.began).tm_gmtoff
            text = page(course, origin, plotly, words.clock, offset_s)
            part.write_text(text, encoding="utf-8")
    except OSError as error:
        denied = isinstance(error, PermissionError)
        raise ExitError(
            Exit.NO_PERMISSION if denied else Exit.FAILURE, f"cannot write {new}: {error.strerror}"
        ) from None
    print(f"{new}: {len(text) / 1e6:.1f} MB, for any browser")
    return notes(course, origin)


def _follow(
    recording: Recording, looked: Onlooker, course: Course, tell: Callable[[int], None]
) -> None:
    """All steps that count, into `course`."""
    from acsard.record.again import EVERY

    for number, (step, outputs, robot) in enumerate(looked.steps()):
        if number % EVERY == 0:
            tell(step.inputs.now.wall_ns)
        course.step(step, outputs, robot)
        if course.over:
            deque(recording.messages(), maxlen=0)  # only what is missing of it
            return
