"""Watches the certificates of the bus on the disk: whether they were replaced, and when they end.

Zenoh reads the files of a listening endpoint when it opens it, and the files of a connection when
it connects. A process that listens must therefore know when other files are there: `renewed`. Three
files cannot be replaced at the same moment, so new files count once they belong together and no
longer change.

The ends are those of the robot's own certificate, its authority's and the router's. A thread reads
them again and again, because a disk or a router may not answer.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, MutableMapping
from pathlib import Path

from acsard.core.config.settings import TLS, BusConfig
from acsard.core.values import NS_PER_S
from acsard.daemon.bus.tls import ends, peer_ends_ns, unusable
from acsard.daemon.bus.zenoh_sessions import certificate_trouble
from acsard.host import clock
from acsard.host.threads import NoThreadError, in_thread

FILES_LOOK_NS = 2 * NS_PER_S
"""Time between two looks at the files, ns. Copying three files takes less."""

Signature = tuple[tuple[int, int, int], ...]
"""Inode, size in bytes and time of change in ns of each file; () if one of them is missing."""


class CertificateFiles:
    """The authority, the certificate and the key of a process that listens."""

    def __init__(self, authority: Path, certificate: Path, key: Path) -> None:
        """Begin with the present files, which the process reads after this."""
        self._files = authority, certificate, key
        self._used = self._seen = self._signature()
        self._due_ns = clock.mono_ns() + FILES_LOOK_NS

    def renewed(self) -> bool:
        """Return True once after each change to other files that can be used together.

        It looks at the files at most every `FILES_LOOK_NS`, and returns False in between.
        """
        now_ns = clock.mono_ns()
        if now_ns < self._due_ns:
            return False
        self._due_ns = now_ns + FILES_LOOK_NS
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


ENDS_LOOK_S = 60.0
"""Pause between two looks at the files."""

ROUTER_LOOKS = 60
"""Number of looks at the files for each look at the routers, which costs them a connection.

A router that did not answer is looked at each time.
"""


def ends_of(routers: Iterable[str], directory: str) -> dict[str, int]:
    """Return the ends of the certificates of the routers that answer, as `expiry` takes them.

    `directory` has the certificate with which this machine connects to the routers.
    """
    found = {f"the router {one}": peer_ends_ns(one, directory) for one in routers}
    return {whose: ends_ns for whose, ends_ns in found.items() if ends_ns is not None}


async def watch_certificates(bus: BusConfig, known: MutableMapping[str, int]) -> None:
    """Keep the ends in `known` true, until cancelled. An end that cannot be read stays."""
    routers = [endpoint for endpoint in bus.connect if endpoint.startswith(TLS)]
    answered, look = 0, 0
    while True:
        found: dict[str, int] = {}
        try:
            # Without a time limit: each look at a disk that hangs would leave one more thread.
            if answered < len(routers) or look % ROUTER_LOOKS == 0:
                found |= await in_thread(lambda: ends_of(routers, bus.tls), None)
                answered = len(found)
            found |= await in_thread(lambda: ends(bus.tls), None)
        except NoThreadError:
            pass  # the next look tries again
        if bus.outside:
            # The TLS gateway reports the certificate that it uses.
            found.pop("", None)
        known.update(found)
        look += 1
        await asyncio.sleep(ENDS_LOOK_S)
