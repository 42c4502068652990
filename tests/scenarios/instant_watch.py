"""A replacement for the diagnosis of late periods, for tests in virtual time.

In virtual time the kernel's counters of this process mean nothing.
"""

from __future__ import annotations

from acsard.daemon.late_causes import LatenessEvidence, causes, event_of
from acsard.daemon.late_watch import LateWatch
from acsard.host.kernel_counters import Reading, Scheduled


class InstantWatch(LateWatch):
    """A diagnosis that immediately reports other programs as the cause of each late period."""

    def period(self, now_ns: int, late_ns: int, missed: int) -> None:
        if missed:
            late = LatenessEvidence(late_ns, Scheduled(0, late_ns), Reading(), Reading())
            self._news.put(event_of(late, causes(late)[1], immediate=True))
