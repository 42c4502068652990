"""The far end of the wire for a benchmark, as a program: a simulated MCU on a pty.

A process of its own, woken by the kernel itself, ahead of all others where that is permitted: its
times are those of the wire, whatever the measured program or the measuring one does. Its first
line of output is the device; when its input ends it writes all it saw and ends.
"""

from __future__ import annotations

import gc
import os
import select
import sys
from pathlib import Path

import msgspec
from msgspec.structs import replace

from acsard.bench.matching import staircase
from acsard.bench.record import Seen
from acsard.config.parsing import from_builtins
from acsard.config.settings import Config
from acsard.host import clock
from acsard.host.timerfd import TimerFd
from acsard.serial.pty_end import PtyEnd
from acsard.sim.fake_mcu import FakeMcu

PRIORITY = 80
"""Of real-time scheduling: a microcontroller waits for no host."""


class Part(msgspec.Struct, frozen=True):
    """What the far end plays."""

    config: dict[str, object]
    unprompted: float = 0.0
    """s between reports by its own clock; 0 for an answer to each line."""
    baud_rate: int = 0
    """Of this end, when it shall be another than the configuration may say."""


class NumberedMcu(FakeMcu):
    """Answers in time and form as the simulator does, but each line says a speed of its own."""

    def __init__(self, config: Config, now_ns: int) -> None:
        super().__init__(config, now_ns)
        self._number = 0

    def _speeds(self, now_ns: int) -> list[float]:
        self._number += 1
        speed = staircase(self._number)
        return [forward * speed for _, forward in self._wiring]

    def _pass(self, now_ns: int) -> None:
        self._now_ns = max(self._now_ns, now_ns)  # nothing here moves


class FarEnd:
    """The pty and the MCU behind it, in one blocking loop."""

    def __init__(self, mcu: FakeMcu) -> None:
        self.seen = Seen()
        self._mcu = mcu
        self._pty = PtyEnd()
        self.path = self._pty.path
        self._timer = TimerFd()

    def play(self, until_fd: int) -> None:
        """Until `until_fd` has something to say."""
        poll = select.poll()
        for fd in (self._pty.fileno(), self._timer.fileno(), until_fd):
            poll.register(fd, select.POLLIN)
        self._advance()
        while True:
            ready = [fd for fd, _ in poll.poll()]
            now_ns = clock.mono_ns()
            if self._pty.fileno() in ready:
                self._hear(now_ns)
            if self._timer.fileno() in ready:
                self._timer.expirations()
            self._advance()
            if until_fd in ready:
                return

    def _hear(self, now_ns: int) -> None:
        data = self._pty.read()
        if data:
            self.seen.heard.append((now_ns, data))
            self._mcu.receive(now_ns, data)

    def _advance(self) -> None:
        data = self._mcu.advance(clock.mono_ns())
        if data:
            at_ns = clock.mono_ns()
            if self._pty.write(data):
                self.seen.said.append((at_ns, data))
        due_ns = self._mcu.next_ns()
        if due_ns is not None:
            self._timer.set(due_ns)


def main(part: Part) -> None:
    """Play until standard input ends, then tell all."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError:
        pass  # its times are then as good as the machine is idle
    config = from_builtins(part.config)
    if part.baud_rate:
        config = replace(config, mcu=replace(config.mcu, baud_rate=part.baud_rate))
    mcu = NumberedMcu(config, clock.mono_ns())
    end = FarEnd(mcu)
    sys.stdout.write(end.path + "\n")
    sys.stdout.flush()
    gc.disable()
    if part.unprompted:
        with mcu.unprompted(part.unprompted):
            end.play(sys.stdin.fileno())
    else:
        end.play(sys.stdin.fileno())
    try:
        sys.stdout.buffer.write(msgspec.msgpack.encode(end.seen))
        sys.stdout.flush()
    except BrokenPipeError:
        os._exit(1)  # who asked has been killed


if __name__ == "__main__":
    main(msgspec.json.decode(Path(sys.argv[1]).read_bytes(), type=Part))
