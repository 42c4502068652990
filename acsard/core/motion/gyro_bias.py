"""Learns the bias of a gyro: its reading while the robot stands still (zero-velocity update).

The first estimate is the mean of the samples in `LEARNING_TIME_S`. The bias drifts between rests.
Therefore a scalar Kalman filter models it as a random walk, and a rest has more weight if the
previous rest was long ago.
"""

from __future__ import annotations

import math

LEARNING_TIME_S = 0.5
"""Time at rest after which the bias is known, s."""

MAX_BIAS = 0.2
"""Largest plausible bias, rad/s. A higher rate at rest means that a person turns the robot."""

BIAS_RANDOM_WALK = 1e-4
"""Random walk of a cheap gyro's bias with temperature, rad/s per square root of a second."""

MAX_DEVIATIONS = 5.0
"""Number of standard deviations. A sample at rest counts as noise if it differs from the bias by at
most this number of standard deviations plus `DEVIATION_MARGIN`. A sample that differs by more
contradicts the bias."""

DEVIATION_MARGIN = 0.01
"""Difference of a sample from the bias, rad/s, that is allowed in addition to `MAX_DEVIATIONS`
standard deviations, because a robot that stands still may vibrate."""

MIN_NOISE = 1e-5
"""Smallest assumed standard deviation of a sample, rad/s. A coarse gyro may repeat one value, so
its measured standard deviation may be 0."""

NEW_BIAS_TIME_S = 1.0
"""If a reading at rest differs from the known bias, it becomes the new bias after it has been
constant for this time, s. The gyro may have restarted or warmed up, or the robot may have turned
while the first bias was learned."""

NOISE_GAIN = 0.02
"""Weight of a new sample in the estimate of the noise. About the last fifty samples count."""


class Bias:
    """The estimated bias of a gyro, its variance, and the noise of the gyro's samples."""

    def __init__(self) -> None:
        self.value = 0.0
        """The bias, rad/s."""
        self.variance = MAX_BIAS**2
        """Variance of the estimated bias, rad2/s2."""
        self.noise = 0.0
        """Variance of one sample, rad2/s2."""
        self._rested_s, self._samples = 0.0, 0
        self._other: Bias | None = None
        """A second estimate, from consecutive samples that contradict this estimate."""

    @property
    def is_known(self) -> bool:
        """Whether the robot has stood still long enough to determine the bias."""
        return self._rested_s >= LEARNING_TIME_S

    def drift(self, dt: float) -> None:
        """Increase the variance of the bias by the drift that may occur in `dt` s."""
        self.variance += BIAS_RANDOM_WALK * BIAS_RANDOM_WALK * dt

    def update_at_rest(self, rate: float, variance: float, dt: float) -> bool:
        """Update the bias with a sample that was measured while the wheels stood still.

        Return False if the sample shows that the robot turns, for example by hand. `rate` is in
        rad/s, and `dt` is the time since the previous sample, s. `variance` is the variance of
        `rate` according to the gyro, rad2/s2; 0 if the gyro declares no variance.
        """
        if not self.is_known:
            return self._average(rate, variance, dt)
        self._rested_s += dt
        error = rate - self.value
        noise = max(self.noise, variance, MIN_NOISE**2)
        if abs(error) > MAX_DEVIATIONS * math.sqrt(noise + self.variance) + DEVIATION_MARGIN:
            return self._doubt(rate, variance, dt, noise)
        self._other = None
        gain = self.variance / (self.variance + noise)
        self.value += gain * error
        self.variance *= 1.0 - gain
        # The part of the error by which the bias was corrected is not noise.
        self.noise += NOISE_GAIN * ((1.0 - gain) * error * error - self.noise)
        return True

    def _doubt(self, rate: float, variance: float, dt: float, noise: float) -> bool:
        other = self._other = self._other or Bias()
        if not other.update_at_rest(rate, variance, dt) or other._rested_s < NEW_BIAS_TIME_S:
            return False
        self._other = None
        if math.sqrt(other.noise) > MAX_DEVIATIONS * math.sqrt(noise) + DEVIATION_MARGIN:
            return False
        self.value, self.variance, self.noise = other.value, other.variance, other.noise
        return True

    def _average(self, rate: float, variance: float, dt: float) -> bool:
        """Update bias and noise by Welford's method. Return False if the sample shows a turn."""
        if abs(rate) > MAX_BIAS:
            return False
        self._rested_s += dt
        self._samples += 1
        error = rate - self.value
        self.value += error / self._samples
        self.noise += (error * (rate - self.value) - self.noise) / self._samples
        if self.is_known:
            self.variance = max(self.noise, variance, MIN_NOISE**2) / self._samples
        return True
