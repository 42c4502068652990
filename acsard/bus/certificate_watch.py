"""Detects that the certificate files of the bus were replaced, and reads when they expire.

Zenoh reads the files only when it opens an endpoint, so a process that listens must restart
(`CertificateFiles.renewed`). Three files cannot be replaced at one moment: new ones are reported
when they belong together and stay unchanged. A thread reads the expiry times, because a disk or a
router may not answer.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping, MutableMapping
from pathlib import Path
from typing import NamedTuple

from acsard.bus.tls_files import expiry_times, peer_ends_ns, unusable
from acsard.bus.tls_trouble import RENEW_ADVICE
from acsard.bus.zenoh_sessions import certificate_trouble
from acsard.core.codes import Code, joined
from acsard.core.config.settings import BusConfig
from acsard.core.messages.certificate_expiry import expiry, urgency
from acsard.core.values import NS_PER_S, Event, WallNs
from acsard.host import clock
from acsard.host.threads import NoThreadError, in_thread

FILES_CHECK_PERIOD_NS = 2 * NS_PER_S  # copying three files takes less time

# Inode, size and modification time of each file; () if one is missing.
Signature = tuple[tuple[int, int, int], ...]


class CertificateFiles:
    """The authority, certificate and key of a process that listens.

    Create it before Zenoh reads the files, or a replacement in between is not detected.
    """

    def __init__(self, authority: Path, certificate: Path, key: Path) -> None:
        self._files = authority, certificate, key
        self._used = self._last_signature = self._signature()
        self._due_ns = clock.mono_ns() + FILES_CHECK_PERIOD_NS

    def renewed(self) -> bool:
        """Return True once for each replacement by files that can be used together.

        The files are checked at most once in `FILES_CHECK_PERIOD_NS`.
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
        """Return why Zenoh refuses the new files, or ""; this takes some milliseconds."""
        return certificate_trouble(*self._files)

    def _signature(self) -> Signature:
        try:
            about = [file.stat() for file in self._files]
        except OSError:
            return ()
        return tuple((status.st_ino, status.st_size, status.st_mtime_ns) for status in about)


EXPIRY_CHECK_PERIOD_S = 60.0

# Readings of the own certificates for one of the routers', which takes one of their connections.
# All routers are tried again at the next reading if one did not answer.
ROUTER_CHECK_EVERY = 60


def router_expiry_times(routers: Iterable[str], directory: str) -> dict[str, WallNs]:
    """Return when the certificates of the routers that answer expire, by texts for messages.

    `directory` has this machine's certificate. A text is like "the router tls/HOST:PORT".
    """
    expiries = {f"the router {router}": peer_ends_ns(router, directory) for router in routers}
    return {whose: ends_ns for whose, ends_ns in expiries.items() if ends_ns is not None}


async def watch_certificates(
    bus: BusConfig, known: MutableMapping[str, WallNs], tell: Callable[[Event], None]
) -> None:
    """Update the expiry times in `known` every `EXPIRY_CHECK_PERIOD_S` until cancelled.

    Tells when the first of them comes below each of `EXPIRY_DAYS`, and when it is over.

    Its keys are those of `tls.expiry_times` and `router_expiry_times`. A value stays if a
    certificate cannot be read. With `bus.outside`, the TLS gateway reports the robot's own
    certificate.
    """
    routers = bus.tls_routers
    answered, reading, reported = 0, 0, _Reported("certificate_valid", 0)
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
        reported = _tell_of_change(known, reported, tell)
        reading += 1
        await asyncio.sleep(EXPIRY_CHECK_PERIOD_S)


class _Reported(NamedTuple):
    code: Code
    urgency: int


def _tell_of_change(
    known: Mapping[str, WallNs], reported: _Reported, tell: Callable[[Event], None]
) -> _Reported:
    if not known:
        return reported
    now_ns = clock.now().wall_ns
    why = expiry(known, now_ns, RENEW_ADVICE)
    now = _Reported(why.code, urgency(known, now_ns))
    if now != reported and why.level != "ok":
        tell(Event("certificate", joined(why).text, "warning", code=why.code))
    return now
