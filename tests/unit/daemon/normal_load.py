"""Records late periods that have no cause in the kernel, under the normal load of the machine.

    python -m tests.unit.daemon.normal_load FILE SECONDS

A thread keeps periods of 10 ms as the control loop does, and sometimes sleeps too long on purpose.
The kernel's counters show no cause for this, although other programs run. Each line of the file is
one late period as the daemon's watch sees it. If the thread also waited for a processor, the
machine has caused the lateness itself. Such periods are left out, and the output says how many.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import msgspec

from acsard.core.values import NS_PER_S
from acsard.daemon import late_watch
from acsard.daemon.late_causes import LatenessEvidence
from acsard.daemon.late_watch import LateWatch
from acsard.host import clock
from acsard.host.kernel_counters import Kernel

PERIOD_S = 0.01

SIZES_S = (0.012, 0.02, 0.035, 0.06, 0.1, 0.2)

EVERY = 60
"""Periods from one lateness to the next."""


class Noting(LateWatch):
    """A watch that notes each lateness instead of reporting it."""

    def __init__(self) -> None:
        super().__init__()
        self.noted: list[LatenessEvidence] = []

    def _report(self, kernel: Kernel, late: LatenessEvidence) -> None:
        self.noted.append(late)


def record(seconds: float) -> list[LatenessEvidence]:
    """Be late once in every `EVERY` periods, and return all late periods."""
    late_watch.PAUSE_NS = 0
    with Noting() as watch:
        due = time.monotonic()
        end, number = due + seconds, 0
        while time.monotonic() < end:
            due += PERIOD_S
            time.sleep(max(0.0, due - time.monotonic()))
            late = time.monotonic() - due
            missed = int(late / PERIOD_S)
            watch.period(clock.mono_ns(), int(late * NS_PER_S), missed)
            due += PERIOD_S * missed
            number += 1
            if number % EVERY == 0:
                time.sleep(SIZES_S[number // EVERY % len(SIZES_S)])
        return watch.noted


def main() -> None:
    path, seconds = Path(sys.argv[1]), float(sys.argv[2])
    noted = record(seconds)
    records = [lateness for lateness in noted if lateness.loop.waited_ns < 0.5 * lateness.late_ns]
    path.write_bytes(b"".join(msgspec.json.encode(lateness) + b"\n" for lateness in records))
    print(f"{len(records)} kept, {len(noted) - len(records)} waited for a processor")


if __name__ == "__main__":
    main()
