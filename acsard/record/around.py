"""Which files are close to what happened: a minute before it, and a minute after; pure."""

from __future__ import annotations

from typing import Generic, TypeVar

from acsard.record.room import AROUND_NS, Kind

File = TypeVar("File")


class Around(Generic[File]):
    """Follows one file after another; times are ns of the clock that nobody sets."""

    def __init__(self) -> None:
        self.kind: Kind = "plain"
        """Of the file that is being written."""
        self._recent: list[tuple[File, int]] = []
        """What ended less than a minute ago, and when; nothing has happened close to it yet."""
        self._happened_ns = -AROUND_NS

    def begin(self, now_ns: int) -> None:
        """A file begins."""
        self.kind = "near" if now_ns - self._happened_ns < AROUND_NS else "plain"

    def happened(self, now_ns: int) -> list[File]:
        """Something has: this file stays, and so do the ones returned, which ended before it."""
        self.kind, self._happened_ns = "kept", now_ns
        close = [file for file, ended_ns in self._recent if now_ns - ended_ns < AROUND_NS]
        self._recent.clear()
        return close

    def end(self, file: File, last_ns: int) -> None:
        """The file ends."""
        self._recent = [(one, ns) for one, ns in self._recent if last_ns - ns < AROUND_NS]
        if self.kind == "plain":
            self._recent.append((file, last_ns))

    def earlier(self, file: File, kind: Kind, ended_ns: int) -> None:
        """One that the run before this one has left."""
        if kind == "plain":
            self._recent.append((file, ended_ns))
        elif kind == "kept":
            self.earlier_happened(ended_ns)

    def earlier_happened(self, at_ns: int) -> None:
        """Something did, before this run."""
        self._happened_ns = max(self._happened_ns, at_ns)
