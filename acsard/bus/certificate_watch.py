"""Detects that the certificate files of the bus were replaced, and reads when they expire.

Zenoh reads the files of a listening endpoint only when it opens the endpoint. So a process that
listens must detect new files and restart (`CertificateFiles.renewed`). Three files cannot be
replaced at the same moment, so new files are reported only when they belong together and stay
unchanged. A thread reads the expiry times, because a disk or a router may not answer.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, MutableMapping
from pathlib import Path

from acsard.bus.tls import expiry_times, peer_ends_ns, unusable
from acsard.bus.zenoh_sessions import certificate_trouble
from acsard.core.config.settings import BusConfig
from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.host.threads import NoThreadError, in_thread

FILES_CHECK_PERIOD_NS = 2 * NS_PER_S
"""Time between two checks for replaced files, ns. Copying three files takes less time. So if the
files have not changed between two checks, all of them have been copied."""

Signature = tuple[tuple[int, int, int], ...]
"""Inode, size in bytes and modification time in ns of each file; () if a file is missing."""


class CertificateFiles:
    """The three TLS files of a process that listens: authority, certificate and key.

    `renewed` detects that they were replaced.
    """

    def __init__(self, authority: Path, certificate: Path, key: Path) -> None:
        """Record the present state of the files.

        Call this before Zenoh reads the files. If a file were replaced after Zenoh has read it and
        before this call, `renewed` would not detect that.
        """
        self._files = authority, certificate, key
        self._used = self._last_signature = self._signature()
        self._due_ns = clock.mono_ns() + FILES_CHECK_PERIOD_NS

    def renewed(self) -> bool:
        """Return whether the files have been replaced by new ones that can be used together.

        Return True only once for each replacement. The files are checked at most once in
        `FILES_CHECK_PERIOD_NS`.
        """
        now_ns = clock.mono_ns()
        if now_ns < self._due_ns:
            return False
        self._due_ns = now_ns + FILES_CHECK_PERIOD_NS
        before, self._last_signature = self._last_signature, self._signature()
        new = self._last_signature
        if new != before or new in (self._used, ()) or unusable(*self._files):
            return False
        self._used = new
        return True

    def refused(self) -> str:
        """Return the reason why Zenoh refuses the present files, or "" if Zenoh accepts them.

        Call this after `renewed` has returned True. The call takes some milliseconds.
        """
        return certificate_trouble(*self._files)

    def _signature(self) -> Signature:
        try:
            about = [file.stat() for file in self._files]
        except OSError:
            return ()
        return tuple((status.st_ino, status.st_size, status.st_mtime_ns) for status in about)


EXPIRY_CHECK_PERIOD_S = 60.0
"""Pause between two readings of the certificates' expiry times, s."""

ROUTER_CHECK_EVERY = 60
"""The routers' certificates are read once for this number of readings of the robot's own
certificates. The routers' certificates are read less often, because each reading takes one of a
router's connections. If a router did not answer, all routers are tried again at the next reading of
the robot's certificates."""


def router_expiry_times(routers: Iterable[str], directory: str) -> dict[str, int]:
    """Return the expiry time of each router's certificate, ns since 1970.

    A router that does not answer is left out. The keys of the returned dict are texts for messages,
    such as "the router tls/HOST:PORT".

    Args:
        routers: the endpoints of the routers.
        directory: the directory with the certificate of this machine.
    """
    expiries = {f"the router {router}": peer_ends_ns(router, directory) for router in routers}
    return {whose: ends_ns for whose, ends_ns in expiries.items() if ends_ns is not None}


async def watch_certificates(bus: BusConfig, known: MutableMapping[str, int]) -> None:
    """Update the expiry times in `known` every `EXPIRY_CHECK_PERIOD_S` until cancelled.

    If a certificate cannot be read, its value stays unchanged. If `bus.outside` names endpoints,
    the value of the robot's own certificate stays unchanged too, because the TLS gateway reports
    this value.

    Args:
        bus: the settings with the certificate directory and the routers.
        known: maps the name of each certificate to its expiry time, ns since 1970. The names are
            the dict keys of `tls.expiry_times` and `router_expiry_times`.
    """
    routers = bus.tls_routers
    answered, reading = 0, 0
    while True:
        expiries: dict[str, int] = {}
        try:
            # Wait without a time limit. With a limit, each attempt to read from a disk that hangs
            # would leave one more blocked thread.
            if answered < len(routers) or reading % ROUTER_CHECK_EVERY == 0:
                expiries |= await in_thread(lambda: router_expiry_times(routers, bus.tls), None)
                answered = len(expiries)
            expiries |= await in_thread(lambda: expiry_times(bus.tls), None)
        except NoThreadError:
            pass  # the next round tries again
        if bus.outside:
            # The TLS gateway reports the certificate that it uses.
            expiries.pop("", None)
        known.update(expiries)
        reading += 1
        await asyncio.sleep(EXPIRY_CHECK_PERIOD_S)
