"""The built-in simulator beside the daemon: a serial device, and its true state on the bus.

The control loop reads the device like any other and knows nothing about the rest.
"""

from __future__ import annotations

from types import TracebackType

from acsard.config.settings import Config
from acsard.host import clock
from acsard.incoming.bus_interface import Bus
from acsard.messages.schema import Message
from acsard.messages.topics import IMU
from acsard.serial.sim_pty import SimPty
from acsard.sim.told import true_pose, turn_rate
from acsard.sim.watched import Sight, WatchedMcu
from acsard.values import NS_PER_S

POSE = "sim/pose"


class Simulated:
    """The simulator.

    Entering it creates the device at `path`; `tell` sets the bus to publish on.
    """

    def __init__(self, config: Config) -> None:
        self._pty = SimPty(WatchedMcu(config, clock.mono_ns(), self._see))
        self._frame, self._noise = config.odometry.base_frame, config.sim.gyro_noise
        self._gyro = config.odometry.gyro
        self._delay_ns = int(config.sim.gyro_delay * NS_PER_S)
        self._bus: Bus | None = None
        self._last: tuple[Sight, int] | None = None

    @property
    def path(self) -> str:
        """The path of the serial device."""
        return self._pty.path

    def tell(self, bus: Bus) -> None:
        """Publish on this bus from now on."""
        self._bus = bus

    def current(self, key: str) -> Message | None:
        """Return the present value of a key that the simulator publishes, else None."""
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
        # The daemon receives its own sample from the bus, like one of a gyro on a real robot.
        if self._gyro:
            measured_ns = wall_ns - self._delay_ns
            bus.publish(IMU, turn_rate(sight, self._frame, self._noise, measured_ns))
        bus.flush()
