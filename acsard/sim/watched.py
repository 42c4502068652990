"""The simulated robot with somebody who sees where it truly is, and with its gyro.

What is seen is no business of the microcontroller, which sends what its encoders say and no more.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from msgspec import Struct

from acsard.config.settings import Config
from acsard.sim.fake_mcu import FakeMcu
from acsard.sim.noise import gauss
from acsard.values import NS_PER_S, Pose

LOOK_NS = NS_PER_S // 100
"""Between two looks, and two samples of the gyro."""


class Sight(Struct, frozen=True):
    """One look at `at_ns`, monotonic: the true pose, and what the gyro says then, rad/s.

    The gyro's is a mean over the time between two looks, which ended `[sim] gyro_delay` ago.
    """

    at_ns: int
    pose: Pose
    gyro: float


class WatchedMcu(FakeMcu):
    """A `FakeMcu` whose robot is looked at a hundred times a second, while time passes."""

    def __init__(self, config: Config, now_ns: int, see: Callable[[Sight], None]) -> None:
        super().__init__(config, now_ns)
        self._sim, self._see = config.sim, see
        self._delay_ns = int(config.sim.gyro_delay * NS_PER_S)
        self._looks = 0
        self._look_ns = now_ns + LOOK_NS
        self._history: deque[tuple[int, float]] = deque([(now_ns, 0.0)])
        """When it had turned by how much, as far back as the gyro needs."""

    def next_ns(self) -> int:
        """When it next has something to do, or somebody looks at it."""
        due_ns = super().next_ns()
        return self._look_ns if due_ns is None else min(due_ns, self._look_ns)

    def advance(self, now_ns: int) -> bytes:
        """Let time pass up to `now_ns`; the bytes that have fully arrived at the host since."""
        out = b""
        while self._look_ns <= now_ns:
            out += super().advance(self._look_ns)
            self._look()
            self._look_ns += LOOK_NS
        return out + super().advance(now_ns)

    def _look(self) -> None:
        now_ns, sim = self._look_ns, self._sim
        self._history.append((now_ns, self.vehicle.turned))
        end_ns = now_ns - self._delay_ns
        turned = self._turned(end_ns) - self._turned(end_ns - LOOK_NS)
        while self._history[1][0] <= end_ns - LOOK_NS:
            self._history.popleft()
        rate = turned * NS_PER_S / LOOK_NS + sim.gyro_bias
        rate += sim.gyro_noise * gauss(sim.seed, self._looks)
        self._looks += 1
        self._see(Sight(now_ns, self.vehicle.pose, rate))

    def _turned(self, at_ns: int) -> float:
        """rad by then; it stood before the first look."""
        before_ns, before = self._history[0]
        if at_ns <= before_ns:
            return before
        for then_ns, turned in self._history:
            if then_ns >= at_ns:
                share = (at_ns - before_ns) / max(1, then_ns - before_ns)
                return before + share * (turned - before)
            before_ns, before = then_ns, turned
        return before
