"""The simulated board at the end of a pty, in real time, for the daemon's real serial code.

A pty carries data at any baud rate, so this garbles them if the daemon's is not the board's.
"""

from __future__ import annotations

import asyncio
import errno
import os
import pty
import tty
from typing import Self, get_args

from acsard.core.config.settings import Baud, Config
from acsard.core.incoming.bus_interface import BusOutput
from acsard.core.messages.keys_and_roles import IMU
from acsard.core.messages.schema import Message
from acsard.core.simulator.baud_mismatch import garbled
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.simulator.simulated_robot import Observation, WatchedMcu
from acsard.core.simulator.true_messages import true_pose, turn_rate
from acsard.daemon.serial.device import baud_rate_of, set_baud_rate, unlock
from acsard.host import clock
from acsard.host.timerfd import TimerFd


class PtyEnd:
    """The board's end of a pty. No method blocks."""

    def __init__(self) -> None:
        self._master, self.slave = pty.openpty()
        # Keep the slave open. Otherwise the master sees a hang-up whenever no host is connected.
        tty.setraw(self.slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self.slave)

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes:
        """Return the bytes that the host has written."""
        try:
            data = os.read(self._master, 4096)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EIO):
                return b""
            raise
        # A host that is killed leaves its lock on the pty. Remove the lock, because a real port
        # would not keep it.
        unlock(self.slave)
        return data

    def write(self, data: bytes) -> bool:
        """Send data to the host; if the buffer is full, drop the rest and return False."""
        try:
            return os.write(self._master, data) == len(data)
        except BlockingIOError:
            return False

    def close(self) -> None:
        os.close(self._master)
        os.close(self.slave)


# Of the board's input buffer: seven lines. After a stall of this process, the pty holds all lines
# that the host has written meanwhile. No board holds so many: it would obey within 0.1 s what was
# commanded in one second, and the daemon would see wheels that roll on.
INPUT_BYTES = 256


class SimPty:
    """The simulated board at one end of a pty; `path` is the daemon's device in a `with` block."""

    def __init__(self, mcu: FakeMcu) -> None:
        self.mcu = mcu
        self.path = ""
        self._timer = TimerFd()

    def __enter__(self) -> Self:
        self._end = PtyEnd()
        self.path = self._end.path
        # In case the host sets none.
        set_baud_rate(self._end.slave, self.mcu.switches.baud_rate)
        loop = asyncio.get_running_loop()
        loop.add_reader(self._end.fileno(), self._read)
        loop.add_reader(self._timer.fileno(), self._advance)
        self._arm()
        return self

    def __exit__(self, *_: object) -> None:
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._end.fileno())
        loop.remove_reader(self._timer.fileno())
        self._timer.close()
        self._end.close()

    def _read(self) -> None:
        data = self._end.read()
        if len(data) > INPUT_BYTES:
            data = data[-INPUT_BYTES:].partition(b"\n")[2]
        if data:
            now_ns = clock.now().mono_ns
            self.mcu.receive(now_ns, garbled(data, self._speed(), self.mcu.switches.baud_rate))
            self._arm()

    def _speed(self) -> int:
        # The board's, for a rate that acsard does not support.
        rate = baud_rate_of(self._end.slave)
        return rate if rate in get_args(Baud) else self.mcu.switches.baud_rate

    def _advance(self) -> None:
        self._timer.expirations()
        data = self.mcu.advance(clock.now().mono_ns)
        if data:
            self._end.write(garbled(data, self.mcu.switches.baud_rate, self._speed()))
        self._arm()

    def _arm(self) -> None:
        due_ns = self.mcu.next_ns()
        if due_ns is not None:
            self._timer.set(due_ns)


TRUE_POSE_KEY = "sim/pose"


class Simulated(SimPty):
    """The simulated board of a daemon, with the true pose and the gyro."""

    def __init__(self, config: Config) -> None:
        super().__init__(WatchedMcu(config, clock.mono_ns(), self._see))
        self._frame, self._gyro = config.odometry.base_frame, config.odometry.gyro
        self._output: BusOutput | None = None
        self._last: tuple[Observation, int] | None = None

    def publish_on(self, output: BusOutput) -> None:
        """Publish the true pose and the gyro's samples from now on."""
        self._output = output

    def current(self, key: str) -> Message | None:
        """Return the newest true pose for the key `sim/pose`."""
        return true_pose(*self._last) if key == TRUE_POSE_KEY and self._last is not None else None

    def _see(self, sight: Observation) -> None:
        now, output = clock.now(), self._output
        wall_ns = now.wall_ns - (now.mono_ns - sight.at_ns)
        self._last = sight, wall_ns
        if output is None:
            return
        if TRUE_POSE_KEY in output.wanted_keys:
            output.publish(TRUE_POSE_KEY, true_pose(sight, wall_ns))
        # The daemon receives this sample from the bus, like a sample of a gyro on a real robot.
        if self._gyro:
            output.publish(IMU, turn_rate(sight, self._frame, wall_ns))
        output.flush()
