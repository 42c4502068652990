"""Lists the recordings in the directory of the black box, and draws reports of recordings."""

from __future__ import annotations

import asyncio
import calendar
import codecs
import gzip
import signal
import time
from asyncio.subprocess import PIPE, Process
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, Struct

from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.child import Limits, acsard, how_it_ended, running
from acsard.host.threads import NoThreadError, in_thread
from acsard.recording.directory import NAME_TIME_FORMAT, PART_SUFFIX, is_being_recorded, listed
from acsard.recording.end_record import ending_text, read_end
from acsard.web.answers import READ_TIMEOUT_S, TroubleError
from acsard.web.callers import RequestRefusedError, is_loopback
from acsard.web.robots import Robots
from acsard.web.tasks import shared

POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src "
    "'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
"""Content security policy of a report. Because `allow-same-origin` is missing, the report has an
opaque origin. The report itself contains a second policy with the hashes of the allowed scripts,
and the browser enforces both."""

MIN_LIST_INTERVAL_NS = NS_PER_S // 4

CHILD_NICE = 19

DRAW_TIMEOUT_S = 600.0
"""Time limit for drawing a report, s. The report of a full recording (one to four hours) takes
minutes."""

ABANDONED_NS = 60 * NS_PER_S
"""Time, ns, after which the server stops drawing a report if no client requests the progress."""

KEEP_REPORT_NS = 900 * NS_PER_S
"""Time, ns, after which the server discards a finished report if no client requests it again."""

MAX_REPORT_BYTES = 32 << 20
"""Maximum size of a report, bytes; a typical one has 5 to 8 MB."""

MAX_CHILD_MEMORY = 256 << 20
"""Maximum data memory of the child process that draws a report, bytes."""

TOO_LONG = (
    f"the drawing takes longer than {DRAW_TIMEOUT_S / 60:.0f} min here: fetch the recording, and "
    "draw its report on a faster machine with acsard recording report"
)
TOO_MUCH = (
    f"the drawing takes over {MAX_CHILD_MEMORY >> 20} MB of memory: draw the report on another "
    "machine, with acsard recording report"
)
TOO_BIG = (
    f"the report has over {MAX_REPORT_BYTES >> 20} MB: draw a part of the recording, with "
    "acsard recording report --from --to"
)


class Recording(Struct, frozen=True):
    """One recording of the black box."""

    name: str
    begin: Annotated[float | None, Meta(description="s since 1970; null if unknown")]
    seconds: Annotated[
        float | None, Meta(description="duration; null if the recording has no end marker")
    ]
    bytes: int
    events: Annotated[str, Meta(description="summary of the recorded events")]


class BlackBox:
    """The recordings of the daemon of the page's robot.

    Every method raises `TroubleError` if the recordings cannot be read, for example because they
    are on another machine.
    """

    def __init__(self, robots: Robots) -> None:
        self._robots = robots
        self._listing: asyncio.Task[list[Recording]] | None = None
        self._listed_ns = 0
        """Monotonic time at which the task `_listing` was started, ns."""

    async def rows(self) -> list[Recording]:
        """Return all recordings, oldest first. The list may be up to `MIN_LIST_INTERVAL_NS` old."""
        # All requests within `MIN_LIST_INTERVAL_NS` share one list. Otherwise, a client that
        # requests the list all the time would use so much processor time that the stops of other
        # clients are late.
        place, now_ns = self._place(), clock.mono_ns()
        old = now_ns - self._listed_ns > MIN_LIST_INTERVAL_NS
        if self._listing is None or (old and self._listing.done()):
            self._listing = shared(in_thread(lambda: rows(place), READ_TIMEOUT_S))
            self._listed_ns = now_ns
        try:
            return await asyncio.shield(self._listing)
        except (OSError, TimeoutError) as error:
            raise _unread(place, error) from None

    async def find(self, name: str) -> tuple[Path, tuple[int, int]]:
        """Return the path of the recording `name`, and the version of its file.

        The version is the pair (modification time in ns, size in bytes). Raises
        `RequestRefusedError` if the recording does not exist.
        """
        place = self._place()

        def find_file() -> tuple[Path, tuple[int, int]] | None:
            with suppress(FileNotFoundError):  # the daemon has just renamed or deleted the file
                for path in _files(place):
                    if path.name == name:
                        status = path.stat()
                        return path, (status.st_mtime_ns, status.st_size)
            return None

        try:
            entry = await in_thread(find_file, READ_TIMEOUT_S)
        except (OSError, TimeoutError) as error:
            raise _unread(place, error) from None
        if entry is None:
            text = "this recording does not exist; GET /api/recordings lists them"
            raise RequestRefusedError("path", text)
        return entry

    def _place(self) -> Path:
        host = self._robots.endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
        if not (is_loopback(host) or host == "localhost"):
            raise TroubleError(
                404,
                "the recordings are on the robot, but this page's server runs on another machine: "
                "open the page that the robot serves",
            )
        if not self._robots.about.recordings:
            raise TroubleError(
                404,
                "the daemon records nothing, because record.directory is not set: set it and "
                "restart the daemon",
            )
        return Path(self._robots.about.recordings)


def rows(directory: Path) -> list[Recording]:
    """Return all recordings in a directory, oldest first. Raises `OSError` if reading fails.

    If the directory does not exist, return [].
    """
    recordings = []
    for path in _files(directory):
        # The daemon may rename or delete a file meanwhile.
        with suppress(FileNotFoundError):
            recordings.append(_row(path))
    return recordings


def _files(directory: Path) -> list[Path]:
    try:
        return listed(directory)
    except FileNotFoundError:
        return []


def _row(path: Path) -> Recording:
    size, unfinished = path.stat().st_size, path.name.endswith(PART_SUFFIX)
    last = None if unfinished else read_end(path)
    if last is None:
        recorded = unfinished and is_being_recorded(path, time.time())
        words = "being recorded" if recorded else "cut off: no end marker"
        return Recording(path.name, _begun(path), None, size, words)
    events = "; ".join(filter(None, [last.said, ending_text(last.cut, last.why)]))
    seconds = (last.last_ns - last.wall_ns) / NS_PER_S
    return Recording(path.name, last.wall_ns / NS_PER_S, round(seconds, 3), size, events)


def _begun(path: Path) -> float | None:
    try:
        begun = time.strptime(path.name.partition("-")[2].partition(".")[0], NAME_TIME_FORMAT)
    except ValueError:
        return None
    return float(calendar.timegm(begun))


def _unread(place: Path, error: Exception) -> TroubleError:
    words = getattr(error, "strerror", None) or "the disk does not answer; try again"
    return TroubleError(503, f"cannot read {place}: {words}")


# Reports

State = Literal["drawing", "ready", "failed", "busy"]


class ReportState(Struct, frozen=True, omit_defaults=True):
    """The progress or the result of drawing the report of a recording."""

    report: State
    text: Annotated[str, Meta(description="why the report failed, or why the client must wait")] = (
        ""
    )
    percent: int = 0
    seconds: Annotated[float, Meta(description="since the drawing began")] = 0.0
    href: Annotated[
        str, Meta(description="address of the finished report, relative to the page")
    ] = ""


class _Drawing:
    """A report that is being drawn or is finished."""

    def __init__(self, path: Path, stamp: tuple[int, int]) -> None:
        self.path, self.stamp = path, stamp
        self.percent = 0
        self.begun_ns = self.asked_ns = clock.mono_ns()
        self.packed = b""
        """The report, compressed by gzip; empty until the report is finished."""
        self.failed = ""
        self.result_delivered = False
        """True once a client has received the result of the drawing."""

    @property
    def ended(self) -> bool:
        return bool(self.packed or self.failed)


class Reports:
    """Draws one report at a time, in a child process, and keeps the newest report in memory.

    A recording may contain text from unknown senders, so a report could contain a malicious script.
    There are three defenses:

    1. The program that draws the report escapes the text.
    2. The content security policy inside the report allows exactly two scripts, and does not allow
       the report to load anything.
    3. `POLICY` gives the report an opaque origin. So a script in the report could not use the
       cookie or the interface of the robot's page.
    """

    def __init__(self, command: Sequence[str] = ()) -> None:
        """Create an instance without a report.

        `command` is the command that draws a report, without its last argument, the path of the
        recording. If it is empty, use `acsard recording report --supervised`.
        """
        self._command = command or acsard("recording", "report", "--supervised")
        self._drawing: _Drawing | None = None
        self._work: asyncio.Task[None] | None = None

    def request(self, path: Path, stamp: tuple[int, int]) -> ReportState:
        """Return the progress of the report of a recording. Start drawing the report if needed.

        While the report of another recording is being drawn, return the state "busy". When a
        drawing has ended, the next call returns its result, even if the drawing failed. A later
        call draws the report again if the drawing failed, or if the recording has changed since.
        `path` and `stamp` are the results of `BlackBox.find()`.
        """
        drawing, now_ns = self._drawing, clock.mono_ns()
        if drawing is not None and not drawing.ended and drawing.path != path:
            return ReportState(
                "busy",
                f"the report of {drawing.path.name} is being drawn: wait until it is finished",
            )
        if (
            drawing is None
            or drawing.path != path
            or (drawing.result_delivered and (drawing.failed or drawing.stamp != stamp))
        ):
            drawing = self._drawing = _Drawing(path, stamp)
            self._work = asyncio.get_running_loop().create_task(self._draw(drawing))
        drawing.asked_ns, drawing.result_delivered = now_ns, drawing.ended
        if drawing.failed:
            return ReportState("failed", drawing.failed)
        if drawing.packed:
            return ReportState("ready", href=f"report/{path.name}")
        seconds = (now_ns - drawing.begun_ns) / NS_PER_S
        return ReportState("drawing", percent=drawing.percent, seconds=round(seconds, 1))

    def drawn(self, name: str) -> bytes | None:
        """Return the report of the recording `name`, compressed by gzip.

        Return None if this report is not finished or not in memory. Each call restarts the time
        `KEEP_REPORT_NS` after which the report is discarded.
        """
        drawing = self._drawing
        if drawing is None or drawing.path.name != name or not drawing.packed:
            return None
        drawing.asked_ns = clock.mono_ns()
        return drawing.packed

    def tidy(self) -> None:
        """Discard the report if no client has requested it for some time.

        This time is `ABANDONED_NS` while the report is being drawn, and `KEEP_REPORT_NS` after
        that. Call this method once a second.
        """
        drawing = self._drawing
        if drawing is None:
            return
        old_ns = clock.mono_ns() - drawing.asked_ns
        if old_ns > (KEEP_REPORT_NS if drawing.ended else ABANDONED_NS):
            self.end()

    def end(self) -> None:
        """Stop drawing the report, and discard it."""
        if self._work is not None:
            self._work.cancel()
        self._drawing = self._work = None

    async def _draw(self, drawing: _Drawing) -> None:
        try:
            async with asyncio.timeout(DRAW_TIMEOUT_S):
                body = await self._drawn(drawing)
                drawing.packed = await in_thread(lambda: gzip.compress(body, 6, mtime=0), None)
        except NoThreadError as error:
            drawing.failed = str(error)
        except TimeoutError:
            drawing.failed = TOO_LONG
        # Python raises `RuntimeError` if it cannot start a thread for the child process.
        except (OSError, RuntimeError, _FailedError) as error:
            drawing.failed = str(error)

    async def _drawn(self, drawing: _Drawing) -> bytes:
        command, limits = [*self._command, str(drawing.path)], Limits(CHILD_NICE, MAX_CHILD_MEMORY)
        async with running(command, limits, stdout=PIPE, stderr=PIPE) as child:
            listening = asyncio.create_task(_read_errors(child, drawing))
            try:
                body, error_text = await _body(child), await listening
            finally:
                listening.cancel()
            code = await child.wait()
        if code == -signal.SIGKILL:
            raise _FailedError(
                "the operating system ended the drawing, most likely because memory ran out: draw "
                "the report on another machine, with acsard recording report"
            )
        if code:
            raise _FailedError(
                _why(error_text) or f"the program that draws the report {how_it_ended(code)}"
            )
        return body


class _FailedError(Exception):
    """A report could not be drawn. The text of this error is the reason."""


def _why(error_text: str) -> str:
    last = error_text.rpartition("\n")[2]
    if last.startswith("MemoryError"):
        return TOO_MUCH
    return last if error_text.startswith("Traceback") else error_text


async def _body(child: Process) -> bytes:
    assert child.stdout is not None
    body = bytearray()
    while part := await child.stdout.read(1 << 16):
        body += part
        if len(body) > MAX_REPORT_BYTES:
            raise _FailedError(TOO_BIG)
    return bytes(body)


async def _read_errors(child: Process, job: _Drawing) -> str:
    """Read the child's standard error to its end, and return the error text.

    A line of digits is the progress in percent. It updates `job.percent`, and is not a part of the
    error text.
    """
    assert child.stderr is not None
    # A read may end within a character, so the decoder keeps the first bytes of this character.
    text, decoder = "", codecs.getincrementaldecoder("utf-8")(errors="replace")
    while part := await child.stderr.read(1 << 12):
        *lines, rest = (text + decoder.decode(part)).split("\n")
        words = [line for line in lines if not line.isdecimal()]
        numbers = [int(line) for line in lines if line.isdecimal() and len(line) <= 3]
        job.percent = min(100, max([job.percent, *numbers]))
        text = "\n".join([*words, rest])[-2000:]
    return (text + decoder.decode(b"", final=True)).strip().removeprefix("acsard: ")
