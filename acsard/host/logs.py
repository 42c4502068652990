"""structlog: an event -> one line on standard error, never a wait.

Lines are written by a thread of their own from a bounded queue: a full disk, a closed pipe or a
terminal someone has scrolled must not hold up the control loop. What does not fit is dropped.
"""

from __future__ import annotations

import logging
import os
import queue
import sys
import threading
from collections.abc import MutableMapping
from typing import Any, Literal, TextIO

import structlog

from acsard.config.settings import LogConfig
from acsard.host.colours import coloured
from acsard.host.journal import JournalStream, is_journal, render
from acsard.values import Event, EventName

Form = Literal["console", "json", "logfmt", "journal"]

QUEUED_LINES = 1000
"""More than the daemon says in a minute of all troubles at once (`drive/tally.py`)."""

MAX_VALUE = 500
"""Characters of one value: a stranger's words may be in it."""


class Writer:
    """A file that never blocks and never raises."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._lines: queue.Queue[str | None] = queue.Queue(QUEUED_LINES)
        self._thread = threading.Thread(target=self._work, name="log", daemon=True)
        self._thread.start()

    def write(self, text: str) -> int:
        try:
            self._lines.put_nowait(text)
        except queue.Full:
            pass  # the reader is stuck; the robot is not
        return len(text)

    def flush(self) -> None:
        """Nothing to do: the thread flushes each line."""

    def close(self, timeout: float) -> None:
        """Let what is queued out, for at most `timeout` s."""
        try:
            self._lines.put_nowait(None)
        except queue.Full:
            return
        self._thread.join(timeout)

    def _work(self) -> None:
        while (text := self._lines.get()) is not None:
            try:
                write_through(self._stream, text)
            except (OSError, ValueError):
                pass  # disk full or stream closed: logging degrades, control goes on


def write_through(stream: TextIO, text: str) -> None:
    """Write to the stream's descriptor, past its buffer.

    A thread that is stuck in a buffered write holds the buffer's lock, and then nobody could
    flush it at the end.
    """
    try:
        fd = stream.fileno()
    except (OSError, ValueError):  # a stream in memory
        stream.write(text)
        return
    data = text.encode(errors="replace")
    while data:
        data = data[os.write(fd, data) :]


class Log:
    """What the daemon writes about itself."""

    def __init__(self, settings: LogConfig, stream: TextIO = sys.stderr) -> None:
        form: Form = settings.format if settings.format != "auto" else _fitting(stream)
        if form == "journal":
            try:
                stream = JournalStream()
            except OSError:
                form = "json"  # no journal here, or a sandbox without it
        self._writer = Writer(stream)
        self._form, self._stream = form, stream
        self.use(settings)

    def use(self, settings: LogConfig) -> None:
        """Tell from this level on; where it goes and how stays as it began."""
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
        """Write an event of the core or of a shell."""
        fields: dict[str, object] = {"text": event.text}
        if event.by:
            fields["by"] = event.by
        if event.count > 1:
            fields["count"] = event.count
        self._logger.log(_LEVELS[event.level], event.name, **fields)

    def info(self, name: EventName, **fields: object) -> None:
        """Write a line of the daemon's own."""
        self._logger.info(name, **fields)

    def close(self) -> None:
        """Write out what is queued; bounded."""
        self._writer.close(0.2)


_LEVELS = {"info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}


def _in_order(logger: object, method: str, line: MutableMapping[str, Any]) -> dict[str, Any]:
    """When, how bad and what come first in every format."""
    first = ("timestamp", "level", "event", "text")
    return {key: line[key] for key in first if key in line} | dict(line)


def _printable(
    logger: object, method: str, line: MutableMapping[str, Any]
) -> MutableMapping[str, Any]:
    """Nothing that moves a terminal's cursor or begins a line of its own."""
    for key, value in line.items():
        if isinstance(value, str) and not (value.isprintable() and len(value) <= MAX_VALUE):
            cut = value[:MAX_VALUE]
            line[key] = "".join(char if char.isprintable() else "?" for char in cut)
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
            # How far it pads; the name was another once.
            return structlog.dev.ConsoleRenderer(14, colors=coloured(stream))
        case "json":
            return structlog.processors.JSONRenderer()
        case "logfmt":
            return structlog.processors.LogfmtRenderer(bool_as_flag=False)
