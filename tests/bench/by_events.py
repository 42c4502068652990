"""A minimal event-driven driver like `polled.py`: it shows the cost of waiting for events.

    python -m tests.bench.by_events --config FILE --port DEVICE

It sends one line in each control period, and an early line when a command arrives, in place of the
next period's. It asks for real-time scheduling and leaves the same gap on the wire, as acsard does:
without them the comparison of latencies would flatter one of the two. A separate thread publishes
the odometry, so that a locked bus does not delay the loop.

The process wakes up twice in each period: for the kernel timer in asyncio, and for the handover to
the thread. Each command causes a third wake-up. The polled driver wakes up once in each period. If
acsard needs more processor time than this driver, its decisions cause the difference.
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

from acsard.bus.subscription import direct
from acsard.core.config.wire_time import wire_ns
from acsard.core.values import NS_PER_S
from acsard.daemon.daemon import SWITCH_INTERVAL_S
from acsard.daemon.pacing import REPLY_TIME_NS
from acsard.host import clock, real_time
from acsard.host.timerfd import TimerFd
from tests.bench.polled import Robot, session_of


class Sender:
    """A thread that publishes messages from a queue, as `acsard/daemon/bus/outlets.py` does."""

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
    """Writes a line when a period ends or a command arrives, and decodes the feedback."""

    def __init__(self, port: serial.Serial, sender: Sender, period_ns: int, gap_ns: int) -> None:
        self.robot = Robot()
        self._port, self._sender, self._period_ns = port, sender, period_ns
        self._gap_ns, self._sent_ns, self._ahead = gap_ns, 0, False
        self._ticks, self._alarm = TimerFd(), TimerFd()
        loop = asyncio.get_running_loop()
        loop.add_reader(self._ticks.fileno(), self._tick)
        loop.add_reader(self._alarm.fileno(), self._alarmed)
        self._ticks.repeat(period_ns)

    def command(self) -> None:
        """Write the newest command, once in a period and after the gap on the wire."""
        if self._ahead:
            return
        now_ns, free_ns = clock.mono_ns(), self._sent_ns + self._gap_ns
        if now_ns < free_ns:
            self._alarm.set(free_ns)
        else:
            self._write()
            self._ahead = True

    def _write(self) -> None:
        os.write(self._port.fileno(), self.robot.line)
        self._sent_ns = clock.mono_ns()

    def _alarmed(self) -> None:
        if self._alarm.expirations():
            self.command()

    def _tick(self) -> None:
        self._ticks.expirations()
        if not self._ahead:
            self._write()
        self._ahead = False

    def data_received(self, data: bytes) -> None:
        self.robot.buffer += data
        while self.robot.read():
            self._sender.leave(self.robot.update(self._period_ns / NS_PER_S))


async def run(config: dict[str, Any], port: serial.Serial) -> None:
    """Run until the process is killed."""
    session, root, source = session_of(config)
    sender = Sender(session.declare_publisher(f"{root}/odom"))
    events = asyncio.get_running_loop()
    line_ns = wire_ns(len(Robot().line), config["mcu"]["baud_rate"])
    period_ns = int(NS_PER_S / config["control"]["rate"])
    loop = Loop(port, sender, period_ns, line_ns + REPLY_TIME_NS)

    def on_command(sample: zenoh.Sample) -> None:
        loop.robot.on_command(sample)
        events.call_soon_threadsafe(loop.command)

    subscriber = session.declare_subscriber(f"{root}/cmd/{source}", direct(on_command))
    await serial_asyncio.connection_for_serial(events, lambda: loop, port)
    gc.freeze()
    await asyncio.Event().wait()
    del subscriber


def main() -> None:
    """Parse `--config` and `--port`, and run the driver."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--config", type=Path)
    parser.add_argument("--port")
    args = parser.parse_args()
    config = tomllib.loads(args.config.read_text())
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    real_time.request()
    with serial.Serial(args.port, config["mcu"]["baud_rate"], timeout=0) as port:
        asyncio.run(run(config, port))


if __name__ == "__main__":
    main()
