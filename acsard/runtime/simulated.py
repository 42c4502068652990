"""The built-in simulator beside the daemon: a serial device, and on the bus what is true of it.

The control loop reads the device as any other and knows nothing of the rest.
"""

from __future__ import annotations

from types import TracebackType

from acsard.config.settings import Config
from acsard.host import clock
from acsard.incoming.bus import Bus
from acsard.messages.schema import Message
from acsard.messages.topics import IMU
from acsard.serial.sim_pty import SimPty
from acsard.sim.told import true_pose, turn_rate
from acsard.sim.watched import Sight, WatchedMcu

POSE = "sim/pose"


class Simulated:
    """Enter it to get the device at `path`; `tell` a bus of what is seen."""

    def __init__(self, config: Config) -> None:
        self._pty = SimPty(WatchedMcu(config, clock.mono_ns(), self._see))
        self._frame, self._noise = config.odometry.base_frame, config.sim.gyro_noise
        self._gyro = config.odometry.gyro
        self._bus: Bus | None = None
        self._last: tuple[Sight, int] | None = None

    @property
    def path(self) -> str:
        """The serial device."""
        return self._pty.path

    def tell(self, bus: Bus) -> None:
        """Publish from now on."""
        self._bus = bus

    def current(self, key: str) -> Message | None:
        """The present value of a key that is published here."""
        return true_pose(*self._last) if key == POSE and self._last is not None else None

    def __enter__(self) -> Simulated:
        self._pty.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._pty.__exit__(kind, error, trace)

    def _see(self, sight: Sight) -> None:
        now, bus = clock.now(), self._bus
        wall_ns = now.wall_ns - (now.mono_ns - sight.at_ns)
        self._last = sight, wall_ns
        if bus is None:
            return
        if POSE in bus.wanted:
            bus.publish(POSE, true_pose(sight, wall_ns))
        if self._gyro:  # heard by our own subscriber too, as a gyro on the robot would be
            bus.publish(IMU, turn_rate(sight, self._frame, self._noise))
        bus.flush()
