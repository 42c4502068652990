"""Writes log lines to the systemd journal, each as a datagram with fields of its own.

With these fields, `journalctl ACSARD_EVENT=link_down` finds exactly the lines of an event.
"""

from __future__ import annotations

import io
import os
import socket
from collections.abc import Mapping, MutableMapping
from typing import Any, TextIO

SOCKET = "/run/systemd/journal/socket"

_PRIORITIES = {"debug": 7, "info": 6, "warning": 4, "error": 3}
"""Priorities of syslog."""


def is_journal(stream: TextIO, environ: Mapping[str, str]) -> bool:
    """Return whether the stream leads to the journal, according to systemd's JOURNAL_STREAM."""
    try:
        found = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return environ.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}"


def render(logger: object, method: str, line: MutableMapping[str, Any]) -> str:
    """Render a structlog line in the journal's own protocol."""
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
    """Stream that sends each write as a datagram. Raises `OSError` without a journal."""

    def __init__(self, path: str = SOCKET) -> None:
        super().__init__()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        try:
            self._socket.connect(path)
        except OSError:
            self._socket.close()
            raise

    def write(self, text: str) -> int:
        """Send one line of the log."""
        self._socket.send(text.encode(errors="replace"))
        return len(text)
