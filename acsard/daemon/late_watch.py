"""Detects late control periods, and reports the causes that the kernel's counters show.

In each period the control loop reads only one small file, `schedstat`, with the processor times of
its thread. The kernel's other files take longer to read. So a thread of this module reads them four
times a second, and once more after a late period. `late_causes.py` compares the reading from before
the lateness with the reading from after the lateness.

A late period leads to two events with the name `missed_periods`. The robot's own event comes first
and states the number of missed periods. The event of this module follows when the cause is known.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from typing import Self

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.values import NS_PER_S, Event
from acsard.daemon.late_causes import LatenessEvidence, causes, event_of
from acsard.host import clock
from acsard.host.kernel_counters import Kernel, Program, Reading, Scheduled, scheduled
from acsard.host.mailbox import Mailbox

THREAD_TIMES_FILE = "/proc/thread-self/schedstat"
"""File with the processor times of the thread that opens it."""

READ_PERIOD_S = 0.25
"""Time between two readings of the kernel's counters while no period is late, s. If this time were
longer, the comparison would include delays from long before the late period."""

MAX_READINGS = 12
"""Number of readings of the kernel's counters that are kept. They cover the last 3 s, so the oldest
one is from before the lateness, unless the lateness was longer than 3 s."""

SETTLE_S = 0.03
"""Time from a late period to the next reading of the kernel's counters, s. The reading must wait,
because the kernel updates some counters only at its next tick. Ticks are at most 10 ms apart."""

PAUSE_NS = NS_PER_S
"""Shortest time between two reports of causes, ns. A shorter time is useless, because the log shows
at most one line a second for each event name."""

CONDITIONS_PERIOD_NS = 10 * NS_PER_S
"""Time after which the conditions of the processor, such as its voltage, are read again, ns. They
are not read more often, because on some computers each reading is a request to the firmware."""

SEARCH_S = 0.2
"""Time between two readings of the processor times of all processes, s. A search for the busiest
process compares these two readings."""

MIN_SEARCH_INTERVAL_NS = 10 * NS_PER_S
"""Shortest time between two searches for the busiest process, ns. A search takes 20 us per
process."""

REPEAT_EVENT_NS = 60 * NS_PER_S
"""If an event with the same causes was logged less than this time ago, ns, a new event is not
logged immediately. It waits for the next log line about missed periods (`Event.news`)."""

MAX_QUEUED = 16
"""Size of two queues: the late periods that wait for the thread, and the events that wait for a
call of `take_events`. A newer item displaces the oldest one."""


class Late(Struct, frozen=True):
    """A late period, which the control loop passes to the thread of `LateWatch`."""

    now_ns: int
    """Monotonic time at which the step of the late period began, ns."""
    late_ns: int
    """Time from the due time of the first missed period to `now_ns`, ns."""
    before: bytes
    """Content of `THREAD_TIMES_FILE` in the period before the late period; b"" if it is unknown.

    If the first period of the daemon is late, `before` is the content at the start of the
    `LateWatch`."""
    after: bytes
    """Content of `THREAD_TIMES_FILE` in the late period; b"" if it is unknown."""

    @property
    def thread_times(self) -> Scheduled:
        """Time for which the control loop's thread ran, and time for which it waited to run, ns.

        The thread waits to run while no processor is free for it. Both times are measured from the
        step before the late period to the late step.
        """
        before, after = scheduled(self.before), scheduled(self.after)
        return Scheduled(after.ran_ns - before.ran_ns, after.waited_ns - before.waited_ns)


class LateWatch:
    """Detects late periods of one control loop, and finds their causes. It is a context manager.

    The control loop's own thread must create this object, and call `period` and `take_events`. A
    second thread reads the kernel's files while the context is open.
    """

    def __init__(self, kernel: Kernel | None = None) -> None:
        """Open the file with the processor times of the calling thread.

        `kernel` reads the kernel's files. Only tests pass this argument.
        """
        self._kernel = kernel
        self._box = Mailbox[Late](MAX_QUEUED)
        self._news = Mailbox[Event](MAX_QUEUED, lambda: None)
        self._thread = threading.Thread(target=self._work, name="lateness", daemon=True)
        try:
            self._file = os.open(THREAD_TIMES_FILE, os.O_RDONLY | os.O_CLOEXEC)
        except OSError:
            # This kernel does not measure the times of threads.
            self._file = -1
        self._times = self._read_times()
        self._readings: deque[tuple[int, Reading]] = deque(maxlen=MAX_READINGS)
        """The last readings, each with the monotonic time at which it was complete, ns."""
        self._reported: dict[tuple[str, ...], int] = {}
        """Maps each combination of causes to the monotonic time at which an event with these causes
        was last logged immediately (`Event.news`), ns."""
        self._busiest: Program | None = None
        self._searched_ns: int | None = None

    def __enter__(self) -> Self:
        try:
            self._thread.start()
        except RuntimeError:
            # This process cannot start another thread. The robot drives, but no cause of a lateness
            # is found.
            self._box.close()
        return self

    def __exit__(self, *_: object) -> None:
        self._box.close()
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    # The control loop's thread calls these methods.

    def period(self, now_ns: int, late_ns: int, missed: int) -> None:
        """Read the processor times of this thread at the start of each period's step.

        If periods were missed, also let the second thread find the causes.

        Args:
            now_ns: monotonic time at which the step began, ns.
            late_ns: time from the due time of this period to `now_ns`, ns. If periods were missed,
                the time is measured from the due time of the first missed period.
            missed: number of periods just before this one that got no step.
        """
        before, self._times = self._times, self._read_times()
        if missed:
            self._box.put(Late(now_ns, late_ns, before, self._times))

    def _read_times(self) -> bytes:
        try:
            return os.pread(self._file, 64, 0) if self._file >= 0 else b""
        except OSError:
            # Without these times, the thread still finds some of the causes.
            return b""

    def take_events(self) -> list[Event]:
        """Return the events about causes of late periods since the last call."""
        return self._news.take() if self._news.waiting else []

    # The other methods run in the watch's thread.

    def _work(self) -> None:
        kernel = self._kernel or Kernel()
        conditions, looked_ns = kernel.conditions(), clock.mono_ns()
        free_ns = looked_ns
        self._keep(kernel.read(conditions))
        while not self._box.closed:
            if not self._box.wait(READ_PERIOD_S):
                if clock.mono_ns() - looked_ns >= CONDITIONS_PERIOD_NS:
                    conditions, looked_ns = kernel.conditions(), clock.mono_ns()
                self._keep(kernel.read(conditions))
                continue
            time.sleep(max(SETTLE_S, (free_ns - clock.mono_ns()) / NS_PER_S))
            late = max(self._box.take(), key=lambda period: period.late_ns, default=None)
            before = None if late is None else self._before(late.now_ns - late.late_ns)
            after = kernel.read()
            conditions, looked_ns = after.conditions, clock.mono_ns()
            self._keep(after)
            if late is not None and before is not None:
                self._report(
                    kernel, LatenessEvidence(late.late_ns, late.thread_times, before, after)
                )
                free_ns = clock.mono_ns() + PAUSE_NS

    def _keep(self, reading: Reading) -> None:
        self._readings.append((clock.mono_ns(), reading))

    def _before(self, now_ns: int) -> Reading | None:
        older = [reading for read_ns, reading in self._readings if read_ns <= now_ns]
        return older[-1] if older else None

    def _report(self, kernel: Kernel, late: LatenessEvidence) -> None:
        names, clause = causes(late)
        if "processor" in names:
            late = replace(late, busiest=self._busiest_of(kernel))
            names, clause = causes(late)
        if not names:
            return
        now_ns = clock.mono_ns()
        reported_ns = self._reported.get(names)
        immediate = reported_ns is None or now_ns - reported_ns >= REPEAT_EVENT_NS
        if immediate:
            self._reported[names] = now_ns
        self._news.put(event_of(late, clause, immediate=immediate))

    def _busiest_of(self, kernel: Kernel) -> Program | None:
        now_ns = clock.mono_ns()
        if self._searched_ns is None or now_ns - self._searched_ns >= MIN_SEARCH_INTERVAL_NS:
            self._busiest, self._searched_ns = kernel.busiest(SEARCH_S), now_ns
        return self._busiest
