"""Observes the true motion of the simulated robot 100 times per second, and simulates a gyro.

The simulated board does not use this: it reports only what its encoders measure.
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.values import NS_PER_S, Ns, Pose

OBSERVATION_PERIOD_NS = NS_PER_S // 100  # of the gyro, too


class Observation(Struct, frozen=True):
    """The true motion of the simulated robot at one time, and what its gyro reports."""

    at_ns: Ns
    pose: Pose
    gyro: float  # rad/s, the mean since the last observation


class WatchedMcu(FakeMcu):
    """A `FakeMcu` that passes an `Observation` to a callback every 10 ms of simulated time."""

    def __init__(self, config: Config, now_ns: Ns, see: Callable[[Observation], None]) -> None:
        super().__init__(config, now_ns)
        self._see = see
        self._look_ns = now_ns + OBSERVATION_PERIOD_NS
        self._turned = 0.0  # rad until the last observation

    def next_ns(self) -> Ns:
        due_ns = super().next_ns()
        return self._look_ns if due_ns is None else min(due_ns, self._look_ns)

    def advance(self, now_ns: Ns) -> bytes:
        out = b""
        while self._look_ns <= now_ns:
            out += super().advance(self._look_ns)
            self._observe()
            self._look_ns += OBSERVATION_PERIOD_NS
        return out + super().advance(now_ns)

    def _observe(self) -> None:
        vehicle = self.vehicle
        turned, self._turned = vehicle.turned - self._turned, vehicle.turned
        rate = turned * NS_PER_S / OBSERVATION_PERIOD_NS
        self._see(Observation(self._look_ns, vehicle.pose, rate))
