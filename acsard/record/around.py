"""Decides which recording files are retained around an incident: those within a minute of it."""

from __future__ import annotations

from typing import Generic, TypeVar

from acsard.record.room import AROUND_NS, Kind

File = TypeVar("File")


class Around(Generic[File]):
    """Retention of recording files around incidents, decided in the order in which the files end.

    All times are ns of the monotonic clock.
    """

    def __init__(self) -> None:
        self.kind: Kind = "plain"
        """Retention class of the file that is being written."""
        self._recent: list[tuple[File, int]] = []
        """Plain files that ended less than a minute ago, each with its end time."""
        self._happened_ns = -AROUND_NS

    def begin(self, now_ns: int) -> None:
        """Register the beginning of a new file at `now_ns`."""
        self.kind = "near" if now_ns - self._happened_ns < AROUND_NS else "plain"

    def happened(self, now_ns: int) -> list[File]:
        """Retain the current file because of an incident at `now_ns`.

        Returns the earlier files to retain as well, which ended less than a minute before the
        incident.
        """
        self.kind, self._happened_ns = "kept", now_ns
        close = [file for file, ended_ns in self._recent if now_ns - ended_ns < AROUND_NS]
        self._recent.clear()
        return close

    def end(self, file: File, last_ns: int) -> None:
        """Register the end of the current file as `file`, with its last step at `last_ns`."""
        self._recent = [(one, ns) for one, ns in self._recent if last_ns - ns < AROUND_NS]
        if self.kind == "plain":
            self._recent.append((file, last_ns))

    def earlier(self, file: File, kind: Kind, ended_ns: int) -> None:
        """Take over a file that the previous run of the daemon has finished."""
        if kind == "plain":
            self._recent.append((file, ended_ns))
        elif kind == "kept":
            self.earlier_happened(ended_ns)

    def earlier_happened(self, at_ns: int) -> None:
        """Take over the time of an earlier incident, such as the crash of the previous run."""
        self._happened_ns = max(self._happened_ns, at_ns)
