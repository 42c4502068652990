"""What a gyro says while the robot stands: its bias, learned at every rest (zero-velocity update).

The bias walks on between two rests, so that a later rest counts for more the longer ago the last
one is: the scalar Kalman filter of a random walk. The first estimate is the plain mean.
"""

from __future__ import annotations

import math

KNOWN_S = 0.5
"""s of rest that the bias takes to be known at all."""

MAX_BIAS = 0.2
"""rad/s; more than any gyro that is worth its wires has, so the robot is being turned."""

WALK = 1e-4
"""rad/s per square root of a s, by which the bias of a cheap gyro walks (with temperature)."""

UNLIKELY = 5.0
"""Standard deviations from the bias at which a sample is no noise."""

SLACK = 0.01
"""rad/s beside them, for what shakes a robot that stands."""

LEAST_NOISE = 1e-5
"""rad/s; a gyro that says the same again and again is coarse and not without noise."""

ANEW_S = 1.0
"""s of rest in which all says the same other bias, after which it is that: a gyro that was started
again or grew warm, or one that was turned when it was first listened to."""

LEARNING = 0.02
"""Share of a new sample in the estimate of the noise: the last fifty count."""


class Bias:
    """The bias, how certain it is, and the noise of a sample; rad/s."""

    def __init__(self) -> None:
        self.value = 0.0
        self.variance = MAX_BIAS**2
        self.noise = 0.0
        """Variance of one sample."""
        self._rested_s, self._samples = 0.0, 0
        self._other: Bias | None = None
        """What the samples say that contradict it, one after the other."""

    @property
    def known(self) -> bool:
        """The robot has stood for long enough."""
        return self._rested_s >= KNOWN_S

    def drift(self, dt: float) -> None:
        """`dt` s have passed, at rest or not."""
        self.variance += WALK * WALK * dt

    def rest(self, rate: float, variance: float, dt: float) -> bool:
        """A sample while the wheels stand; False, and nothing learned, for one that says a turn.

        `variance` is what the gyro claims for it, 0 where it claims nothing; `dt` s is its share of
        the rest.
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
        # What of the error the bias explains is no noise.
        self.noise += LEARNING * ((1.0 - gain) * error * error - self.noise)
        return True

    def _doubt(self, rate: float, variance: float, dt: float, noise: float) -> bool:
        """A turn of a robot whose wheels stand, or another bias: a turn does not stay the same."""
        other = self._other = self._other or Bias()
        if not other.rest(rate, variance, dt) or other._rested_s < ANEW_S:
            return False
        self._other = None
        if math.sqrt(other.noise) > UNLIKELY * math.sqrt(noise) + SLACK:
            return False
        self.value, self.variance, self.noise = other.value, other.variance, other.noise
        return True

    def _average(self, rate: float, variance: float, dt: float) -> bool:
        """The mean of the first samples, and their spread (Welford)."""
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
