"""As little as `polled.py` does, in acsard's way: what waiting for events costs by itself.

    python -m tests.bench.by_events --config FILE --port DEVICE

A line goes every period, and at once for a command; feedback is told when it comes, by a thread of
its own, so that a bus that is locked holds up nothing. That is asyncio, a timer of the kernel's and
a hand-over: two wake-ups a period where the polled one has one, and a third for each command.
What acsard takes beyond this is what it decides.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import os
import sys
import tomllib
from collections import deque
from pathlib import Path
from threading import Lock, Thread
from typing import Any

import msgspec
import serial
import serial_asyncio
import zenoh

from acsard.bus.outlets import direct
from acsard.host import clock
from acsard.host.timerfd import TimerFd
from acsard.runtime.daemon import SWITCH_INTERVAL_S
from acsard.values import NS_PER_S
from tests.bench.polled import Robot, session_of


class Sender:
    """Puts in a thread what is left with it, as `acsard/bus/outlets.py` does."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self._publisher = publisher
        self._waiting: deque[dict[str, object]] = deque(maxlen=16)
        self._bell = Lock()
        self._bell.acquire()
        Thread(target=self._run, daemon=True).start()

    def leave(self, message: dict[str, object]) -> None:
        self._waiting.append(message)
        if self._bell.locked():
            self._bell.release()

    def _run(self) -> None:
        while True:
            self._bell.acquire()
            while self._waiting:
                self._publisher.put(msgspec.msgpack.encode(self._waiting.popleft()))


class Loop(asyncio.Protocol):
    """What happens at the end of a period, with a command, and with feedback."""

    def __init__(self, port: serial.Serial, sender: Sender, period_ns: int) -> None:
        self.robot = Robot()
        self._port, self._sender, self._period_ns = port, sender, period_ns
        self._timer, self._ahead = TimerFd(), False
        self._due_ns = clock.mono_ns() + period_ns
        self._timer.set(self._due_ns)
        asyncio.get_running_loop().add_reader(self._timer.fileno(), self._tick)

    def write(self) -> None:
        """The newest command, in place of the next period's line."""
        os.write(self._port.fileno(), self.robot.line)
        self._ahead = True

    def _tick(self) -> None:
        self._timer.expirations()
        self._due_ns += self._period_ns
        self._timer.set(self._due_ns)
        if not self._ahead:
            self.write()
        self._ahead = False

    def data_received(self, data: bytes) -> None:
        self.robot.buffer += data
        while self.robot.read():
            self._sender.leave(self.robot.update(self._period_ns / NS_PER_S))


async def run(config: dict[str, Any], port: serial.Serial) -> None:
    """Until it is killed."""
    session, root, source = session_of(config)
    sender = Sender(session.declare_publisher(f"{root}/odom"))
    events = asyncio.get_running_loop()
    loop = Loop(port, sender, int(NS_PER_S / config["control"]["rate"]))

    def on_command(sample: zenoh.Sample) -> None:
        loop.robot.on_command(sample)
        events.call_soon_threadsafe(loop.write)

    kept = session.declare_subscriber(f"{root}/cmd/{source}", direct(on_command))
    await serial_asyncio.connection_for_serial(events, lambda: loop, port)
    gc.freeze()
    await asyncio.Event().wait()
    del kept


def main() -> None:
    """As `polled.py`."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--config", type=Path)
    parser.add_argument("--port")
    args = parser.parse_args()
    config = tomllib.loads(args.config.read_text())
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    with serial.Serial(args.port, config["mcu"]["baud_rate"], timeout=0) as port:
        asyncio.run(run(config, port))


if __name__ == "__main__":
    main()
