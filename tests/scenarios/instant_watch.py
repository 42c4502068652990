"""A watch for worlds in virtual time, in which the kernel's counters mean nothing."""

from __future__ import annotations

from acsard.daemon.late_causes import Lateness, causes, event_of
from acsard.daemon.late_watch import LateWatch
from acsard.host.kernel_counters import Reading, Scheduled


class InstantWatch(LateWatch):
    """A watch that knows at once that other programs caused each late period."""

    def period(self, now_ns: int, late_ns: int, missed: int) -> None:
        if missed:
            late = Lateness(late_ns, Scheduled(0, late_ns), Reading(), Reading())
            self._news.put(event_of(late, causes(late)[1], immediate=True))
