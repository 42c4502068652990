"""Logs events as lines on standard error or in the systemd journal, and never blocks the caller.

A thread writes the lines from a bounded queue, so a full disk, a closed pipe or a stopped terminal
does not delay the control loop. Lines that do not fit are dropped. In the journal, each value of an
event is also a field: `journalctl ACSARD_EVENT=link_down` finds the events `link_down`.
"""

from __future__ import annotations

import io
import logging
import os
import queue
import socket
import sys
from collections.abc import Iterator, Mapping, MutableMapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any, Literal, TextIO, cast

from acsard.core.config.settings import LogConfig
from acsard.core.formatting import printable
from acsard.core.values import Event, EventName
from acsard.host import clock
from acsard.host.terminal_modes import may_use_color
from acsard.host.threads import Worker

# structlog imports rich to draw tracebacks, but this log contains no tracebacks. The daemon's
# modules take 39 MB without rich and 44 MB with it, so rich is hidden while structlog is imported.
sys.modules.setdefault("rich", None)  # type: ignore[arg-type]
import structlog  # noqa: E402

if sys.modules["rich"] is None:
    del sys.modules["rich"]

_PRIORITIES = {"debug": 7, "info": 6, "warning": 4, "error": 3}  # of syslog


def is_journal(stream: TextIO, environ: Mapping[str, str]) -> bool:
    """Return whether the stream is the journal that JOURNAL_STREAM names (device and inode)."""
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def render(logger: object, method: str, line: MutableMapping[str, Any]) -> str:
    """Return a log entry in the journal's protocol (a processor of structlog)."""
    fields = {
        "MESSAGE": _message(line),
        "PRIORITY": str(_PRIORITIES.get(str(line.get("level")), 6)),
        "SYSLOG_IDENTIFIER": "acsard",
    }
    for name, value in line.items():
        if name not in ("timestamp", "level"):
            fields[f"ACSARD_{name.upper()}"] = str(value)
    return "\n".join(f"{name}={value.replace(chr(10), ' ')}" for name, value in fields.items())


def _message(line: Mapping[str, Any]) -> str:
    event, text = str(line.get("event", "")), str(line.get("text", ""))
    rest = [f"{k}={v}" for k, v in line.items() if k not in ("timestamp", "level", "event", "text")]
    return " ".join([f"{event}: {text}" if text else event, *rest])


class JournalStream(io.StringIO):
    """Stream whose `write` sends each text to the systemd journal as a datagram.

    Raises `OSError` if there is no journal at `path`.
    """

    def __init__(self, path: str = "/run/systemd/journal/socket") -> None:
        super().__init__()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        try:
            self._socket.connect(path)
        except OSError:
            self._socket.close()
            raise

    def write(self, text: str) -> int:
        self._socket.send(text.encode(errors="replace"))
        return len(text)


CLOSE_TIMEOUT_S = 0.2  # longest time for which the end of the process waits for queued lines

# Longest time for which a tool with a screen waits for a slow terminal at its end.
MAX_LAST_OUTPUT_S = 10.0

# Bytes written to a terminal at once, and their limit in s: at 9600 baud they take 1.1 s.
MAX_PART, PART_TIMEOUT_S = 1024, 1.5

Form = Literal["console", "json", "journal"]

MAX_VALUE_LENGTH = 500  # characters: a value from another program may have any length


class Writer:
    """Stream whose `write` never blocks and never raises.

    A thread writes to the real stream. A text that does not fit into the queue is dropped.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        # In a minute the daemon logs fewer lines than this queue holds, even with all faults at
        # once (`event_throttle.py`).
        self._lines: queue.Queue[str | None] = queue.Queue(1000)
        self._parts = 0  # written so far
        self._thread = Worker("log", self._work)
        self._thread.start()

    def write(self, text: str) -> int:
        try:
            self._lines.put_nowait(text)
        except queue.Full:
            # The thread is blocked. Drop the line, because the robot must not wait.
            pass
        return len(text)

    def flush(self) -> None: ...

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()

    @property
    def encoding(self) -> str:
        return self._stream.encoding

    @property
    def is_idle(self) -> bool:
        """Return whether everything is written; False while the reader of the stream stalls."""
        return not self._lines.unfinished_tasks

    def close(self, timeout: float, most: float | None = None) -> None:
        """Wait until the queued lines are written, at most `timeout` s.

        If `most` is given, it is the limit, and `timeout` limits a pause without progress.
        """
        try:
            self._lines.put_nowait(None)
        except queue.Full:
            return
        end, before = clock.steady_s() + (timeout if most is None else most), -1
        while before != self._parts and (left := end - clock.steady_s()) > 0:
            before = self._parts
            self._thread.join(min(timeout, left))
            if not self._thread.is_alive():
                return

    def _work(self) -> None:
        while (text := self._lines.get()) is not None:
            try:
                self._write_through(text)
            except (OSError, ValueError):
                # On a full disk or a closed stream the log loses lines, and control goes on.
                pass
            self._lines.task_done()

    def _write_through(self, text: str) -> None:
        # Not through the stream's buffer: a thread that hung in there would keep the buffer's lock,
        # and Python could not flush the stream at the end of the process.
        stream = self._stream
        try:
            fd = stream.fileno()
        # A stream in memory has no descriptor.
        except (OSError, ValueError):
            stream.write(text)
            return
        data = text.encode(stream.encoding or "utf-8", errors="replace")
        # Elsewhere, the lines of two processes must not mix.
        most = MAX_PART if os.isatty(fd) else len(data)
        while data:
            data = data[os.write(fd, data[:most]) :]
            self._parts += 1


@contextmanager
def output_in_threads(most: float | None = None) -> Iterator[None]:
    """Let `sys.stdout` and `sys.stderr` never block during a `with` block, for all Python code.

    At its end, wait for the output as `Writer.close` does.
    """
    output, errors = Writer(sys.stdout), Writer(sys.stderr)
    try:
        with redirect_stdout(cast(TextIO, output)), redirect_stderr(cast(TextIO, errors)):
            yield
    finally:
        timeout = CLOSE_TIMEOUT_S if most is None else PART_TIMEOUT_S
        output.close(timeout, most)
        errors.close(timeout, most)


class Log:
    def __init__(self, settings: LogConfig, stream: TextIO = sys.stderr) -> None:
        form = _fitting(stream)
        if form == "journal":
            try:
                stream = JournalStream()
            except OSError:
                # The journal is missing, or a sandbox hides it.
                form = "json"
        self._writer = Writer(stream)
        self._form, self._stream = form, stream
        self._level = ""
        self.use(settings)

    def use(self, settings: LogConfig) -> None:
        """Use the log level of `settings`; the destination and the format stay."""
        if settings.level == self._level:
            return
        self._level = settings.level
        self._logger: Any = structlog.wrap_logger(
            structlog.WriteLogger(self._writer),  # type: ignore[arg-type]
            processors=[
                structlog.processors.add_log_level,
                structlog.processors.TimeStamper(fmt="iso", utc=self._form != "console"),
                _in_order,
                _printable,
                _renderer(self._form, self._stream),
            ],
            wrapper_class=structlog.make_filtering_bound_logger(
                logging.getLevelNamesMapping()[settings.level.upper()]
            ),
            cache_logger_on_first_use=True,
        )

    def event(self, event: Event) -> None:
        """Log an event, with the client that caused it and the number of occurrences."""
        fields: dict[str, object] = {"text": event.text}
        if event.by:
            fields["by"] = event.by
        if event.count > 1:
            fields["count"] = event.count
        self._logger.log(_LEVELS[event.level.upper()], event.name, **fields)

    def info(self, name: EventName, **fields: object) -> None:
        """Log an event of the daemon itself."""
        self._logger.info(name, **fields)

    def close(self) -> None:
        """Wait at most `CLOSE_TIMEOUT_S` for the queued lines, before the process ends."""
        self._writer.close(CLOSE_TIMEOUT_S)


_LEVELS = logging.getLevelNamesMapping()


def _in_order(logger: object, method: str, line: MutableMapping[str, Any]) -> dict[str, Any]:
    first = ("timestamp", "level", "event", "text")
    return {key: line[key] for key in first if key in line} | dict(line)


def _printable(
    logger: object, method: str, line: MutableMapping[str, Any]
) -> MutableMapping[str, Any]:
    # Escape sequences and line ends of other programs must not reach the terminal.
    for key, value in line.items():
        if isinstance(value, str) and not (value.isprintable() and len(value) <= MAX_VALUE_LENGTH):
            line[key] = printable(value[:MAX_VALUE_LENGTH])
    return line


def _fitting(stream: TextIO) -> Form:
    if is_journal(stream, os.environ):
        return "journal"
    return "console" if stream.isatty() else "json"


def _renderer(form: Form, stream: TextIO) -> Any:
    match form:
        case "journal":
            return render
        case "console":
            # The number is the width to which event names are padded. structlog has renamed the
            # parameter, so it is passed by position.
            return structlog.dev.ConsoleRenderer(14, colors=may_use_color(stream))
        case "json":
            return structlog.processors.JSONRenderer()
