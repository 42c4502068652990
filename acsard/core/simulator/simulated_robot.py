"""Observes the true motion of the simulated robot 100 times per second, and simulates a gyro.

The simulated board does not use this: it reports only what its encoders measure.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.simulator.noise import gauss
from acsard.core.values import NS_PER_S, Ns, Pose

OBSERVATION_PERIOD_NS = NS_PER_S // 100  # of the gyro, too


class Observation(Struct, frozen=True):
    """The true motion of the simulated robot at one time, and what its gyro reports."""

    at_ns: Ns
    pose: Pose
    # rad/s: the mean since the last observation, late by `[sim] gyro_delay`, with bias and noise.
    gyro: float


class WatchedMcu(FakeMcu):
    """A `FakeMcu` that passes an `Observation` to a callback every 10 ms of simulated time."""

    def __init__(self, config: Config, now_ns: Ns, see: Callable[[Observation], None]) -> None:
        super().__init__(config, now_ns)
        self._sim, self._see = config.sim, see
        self._delay_ns = int(config.sim.gyro_delay * NS_PER_S)
        self._looks = 0
        self._look_ns = now_ns + OBSERVATION_PERIOD_NS
        # Not reported yet: time, and rad turned until then.
        self._history: deque[tuple[int, float]] = deque([(now_ns, 0.0)])

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
        now_ns, sim = self._look_ns, self._sim
        self._history.append((now_ns, self.vehicle.turned))
        end_ns = now_ns - self._delay_ns
        turned = self._turned(end_ns) - self._turned(end_ns - OBSERVATION_PERIOD_NS)
        while self._history[1][0] <= end_ns - OBSERVATION_PERIOD_NS:
            self._history.popleft()
        rate = turned * NS_PER_S / OBSERVATION_PERIOD_NS + sim.gyro_bias
        rate += sim.gyro_noise * gauss(sim.seed, self._looks)
        self._looks += 1
        self._see(Observation(now_ns, self.vehicle.pose, rate))

    def _turned(self, at_ns: Ns) -> float:
        before_ns, before = self._history[0]
        if at_ns <= before_ns:
            return before
        for then_ns, turned in self._history:
            if then_ns >= at_ns:
                share = (at_ns - before_ns) / max(1, then_ns - before_ns)
                return before + share * (turned - before)
            before_ns, before = then_ns, turned
        return before
