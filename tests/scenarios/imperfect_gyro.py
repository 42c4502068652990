"""A gyro with the errors of a real one, between the simulated robot and its daemon."""

from __future__ import annotations

from collections import deque

from acsard.core.simulator.simulated_robot import OBSERVATION_PERIOD_NS
from tests.noise import gauss


class ImperfectGyro:
    """Reports `share` times the sum of the true turn rate, a bias and noise, some samples late."""

    def __init__(
        self, bias: float = 0.0, noise: float = 0.0, late: int = 0, share: float = 1.0
    ) -> None:
        self.bias, self.noise, self._share = bias, noise, share
        self.delay_ns = late * OBSERVATION_PERIOD_NS
        self._rates = deque([0.0] * late)
        self._samples = 0

    def rate(self, true: float) -> float:
        """Return the rate that the gyro reports next, rad/s."""
        self._rates.append(true)
        self._samples += 1
        error = self.bias + self.noise * gauss(1, self._samples - 1)
        return self._share * (self._rates.popleft() + error)
