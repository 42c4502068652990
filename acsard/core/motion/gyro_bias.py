"""Learns a gyro's bias, its reading while the robot stands, at every rest (zero-velocity update).

The bias drifts between two rests, so a rest counts for more if the one before was long ago: this is
the scalar Kalman filter of a random walk. The first estimate is the plain mean.
"""

from __future__ import annotations

import math

KNOWN_S = 0.5
"""Seconds of rest before the bias is known."""

MAX_BIAS = 0.2
"""Greatest plausible bias, rad/s. A higher rate means that a person turns the robot."""

WALK = 1e-4
"""Random walk of a cheap gyro's bias with temperature, rad/s per square root of a second."""

UNLIKELY = 5.0
"""Standard deviations from the bias beyond which a sample is not noise."""

SLACK = 0.01
"""rad/s that are allowed in addition, for vibration of a robot that stands."""

LEAST_NOISE = 1e-5
"""Least noise, rad/s. A gyro that repeats one value is coarse, not free of noise."""

ANEW_S = 1.0
"""Seconds of rest with one other bias after which that one is taken. The gyro was restarted or grew
warm, or the robot was turned while the first bias was learned."""

LEARNING = 0.02
"""Weight of a new sample in the estimate of the noise: about the last fifty count."""


class Bias:
    """The bias, its variance, and the noise of a sample; in rad/s and rad2/s2."""

    def __init__(self) -> None:
        self.value = 0.0
        self.variance = MAX_BIAS**2
        self.noise = 0.0
        """Variance of one sample."""
        self._rested_s, self._samples = 0.0, 0
        self._other: Bias | None = None
        """A second estimate, from consecutive samples that contradict this one."""

    @property
    def known(self) -> bool:
        """Whether the robot has stood long enough."""
        return self._rested_s >= KNOWN_S

    def drift(self, dt: float) -> None:
        """Let `dt` s pass, at rest or not."""
        self.variance += WALK * WALK * dt

    def rest(self, rate: float, variance: float, dt: float) -> bool:
        """Learn from a sample while the wheels stand; return False if it shows a turn instead.

        `variance` is the gyro's own claim, 0 without one. `dt` s is the sample's share of the rest.
        """
        if not self.known:
            return self._average(rate, variance, dt)
        self._rested_s += dt
        error = rate - self.value
        noise = max(self.noise, variance, LEAST_NOISE**2)
        if abs(error) > UNLIKELY * math.sqrt(noise + self.variance) + SLACK:
            return self._doubt(rate, variance, dt, noise)
        self._other = None
        gain = self.variance / (self.variance + noise)
        self.value += gain * error
        self.variance *= 1.0 - gain
        # The part of the error that the bias explains is not noise.
        self.noise += LEARNING * ((1.0 - gain) * error * error - self.noise)
        return True

    def _doubt(self, rate: float, variance: float, dt: float, noise: float) -> bool:
        """Return whether a contradicting sample belongs to another bias instead of a turn.

        Another bias is one that stays constant. It then replaces this one.
        """
        other = self._other = self._other or Bias()
        if not other.rest(rate, variance, dt) or other._rested_s < ANEW_S:
            return False
        self._other = None
        if math.sqrt(other.noise) > UNLIKELY * math.sqrt(noise) + SLACK:
            return False
        self.value, self.variance, self.noise = other.value, other.variance, other.noise
        return True

    def _average(self, rate: float, variance: float, dt: float) -> bool:
        """Update the mean of the first samples and their variance (Welford)."""
        if abs(rate) > MAX_BIAS:
            return False
        self._rested_s += dt
        self._samples += 1
        error = rate - self.value
        self.value += error / self._samples
        self.noise += (error * (rate - self.value) - self.noise) / self._samples
        if self.known:
            self.variance = max(self.noise, variance, LEAST_NOISE**2) / self._samples
        return True
