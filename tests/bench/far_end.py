"""The far end of the serial wire in a benchmark: a process that simulates the board on a pty.

The process has real-time priority if it has permission. At its start, it writes the path of the pty
to standard output. When its standard input ends, it writes all recorded data to a file and ends.
"""

from __future__ import annotations

import gc
import os
import select
import sys
from pathlib import Path

import msgspec

from acsard.core.config.parsing import from_builtins
from acsard.core.config.settings import Config
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.daemon.serial.simulator_pty import PtyEnd
from acsard.host import clock
from acsard.host.timerfd import TimerFd
from tests.bench.matching import RecordedTraffic, staircase


class NumberedMcu(FakeMcu):
    """A simulated board that reports the speeds of `staircase()`, not the commanded speeds.

    Successive lines have different speeds, so the benchmark can recognize each line.
    """

    def __init__(self, config: Config, now_ns: int) -> None:
        super().__init__(config, now_ns)
        self._number = 0

    def _speeds(self, now_ns: int) -> list[float]:
        self._number += 1
        speed = staircase(self._number)
        return [forward * speed for _, forward in self._wiring]

    def _pass(self, now_ns: int) -> None:
        # Advance only the time: the reported speeds do not depend on a simulated vehicle.
        self._now_ns = max(self._now_ns, now_ns)


class FarEnd:
    """A simulated board at one end of a pty. The daemon opens the other end, at `path`."""

    def __init__(self, mcu: FakeMcu) -> None:
        self.seen = RecordedTraffic()
        self._mcu = mcu
        self._pty = PtyEnd()
        self.path = self._pty.path
        self._timer = TimerFd()

    def play(self, until_fd: int) -> None:
        """Simulate the board until the file descriptor `until_fd` becomes readable."""
        poll = select.poll()
        for fd in (self._pty.fileno(), self._timer.fileno(), until_fd):
            poll.register(fd, select.POLLIN)
        self._advance()
        while True:
            ready = [fd for fd, _ in poll.poll()]
            now_ns = clock.mono_ns()
            if self._pty.fileno() in ready:
                self._receive(now_ns)
            if self._timer.fileno() in ready:
                self._timer.expirations()
            self._advance()
            if until_fd in ready:
                return

    def _receive(self, now_ns: int) -> None:
        data = self._pty.read()
        if data:
            self.seen.from_daemon.append((now_ns, data))
            self._mcu.receive(now_ns, data)

    def _advance(self) -> None:
        data = self._mcu.advance(clock.mono_ns())
        if data:
            at_ns = clock.mono_ns()
            if self._pty.write(data):
                self.seen.to_daemon.append((at_ns, data))
        due_ns = self._mcu.next_ns()
        if due_ns is not None:
            self._timer.set(due_ns)


def main(config: Config, record: Path) -> None:
    """Simulate the board until standard input ends, then write a `RecordedTraffic` to a file."""
    try:
        # Other processes must not delay the simulated board: a real one has its own processor.
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(80))
    except OSError:
        # Without real-time priority the times are accurate only on an idle machine.
        pass
    mcu = NumberedMcu(config, clock.mono_ns())
    end = FarEnd(mcu)
    sys.stdout.write(end.path + "\n")
    sys.stdout.flush()
    gc.disable()
    end.play(sys.stdin.fileno())
    record.write_bytes(msgspec.msgpack.encode(end.seen))


if __name__ == "__main__":
    main(from_builtins(msgspec.json.decode(Path(sys.argv[1]).read_bytes())), Path(sys.argv[2]))
