"""Notices that a person has put a new certificate in the place of the old one.

Zenoh reads the files of a listening endpoint when it opens it, and the files of a connection when
it connects. A process that listens must therefore know when other files are there. Three files
cannot be replaced at the same moment, so new files count once they belong together and no longer
change.
"""

from __future__ import annotations

from pathlib import Path

from acsard.core.values import NS_PER_S
from acsard.daemon.bus.tls import unusable
from acsard.daemon.bus.zenoh_sessions import certificate_trouble
from acsard.host import clock

LOOK_NS = 2 * NS_PER_S
"""Time between two looks at the files, ns. Copying three files takes less."""

Signature = tuple[tuple[int, int, int], ...]
"""Inode, size in bytes and time of change in ns of each file; () if one of them is missing."""


class CertificateFiles:
    """The authority, the certificate and the key of a process that listens."""

    def __init__(self, authority: Path, certificate: Path, key: Path) -> None:
        """Begin with the present files, which the process reads after this."""
        self._files = authority, certificate, key
        self._used = self._seen = self._signature()
        self._due_ns = clock.mono_ns() + LOOK_NS

    def renewed(self) -> bool:
        """Return True once after each change to other files that can be used together.

        It looks at the files at most every `LOOK_NS`, and returns False in between.
        """
        now_ns = clock.mono_ns()
        if now_ns < self._due_ns:
            return False
        self._due_ns = now_ns + LOOK_NS
        before, self._seen = self._seen, self._signature()
        if self._seen != before or self._seen == self._used or not self._seen:
            return False
        if unusable(*self._files):
            return False
        self._used = self._seen
        return True

    def refused(self) -> str:
        """Return why Zenoh refuses the files that `renewed` has found, or "" if it accepts them."""
        return certificate_trouble(*self._files)

    def _signature(self) -> Signature:
        try:
            about = [file.stat() for file in self._files]
        except OSError:
            return ()
        return tuple((one.st_ino, one.st_size, one.st_mtime_ns) for one in about)
