"""Learns the bias of a gyro: its reading while the robot stands still (zero-velocity update).

The first estimate is a mean over `LEARNING_TIME_S`. Then a scalar Kalman filter models a random
walk, so a rest has more weight if the previous one was long ago.
"""

from __future__ import annotations

import math

LEARNING_TIME_S = 0.5  # at rest, until the bias is known

MAX_BIAS = 0.2  # rad/s; a higher rate at rest is a person who turns the robot

BIAS_RANDOM_WALK = 1e-4  # of a cheap gyro with temperature, rad/s per square root of a second

MAX_DEVIATIONS = 5.0  # standard deviations of a sample from the bias; more is a contradiction

DEVIATION_MARGIN = 0.01  # rad/s beyond `MAX_DEVIATIONS`, because a robot at rest may vibrate

MIN_NOISE = 1e-5  # rad/s of a sample: a coarse gyro may repeat one value

NEW_BIAS_TIME_S = 1.0  # another constant reading at rest: the gyro restarted or warmed up

NOISE_GAIN = 0.02  # of the noise, about fifty samples


class Bias:
    """The estimated bias of a gyro, its variance, and the noise of the gyro's samples."""

    def __init__(self) -> None:
        self.value = 0.0  # rad/s
        self.variance = MAX_BIAS**2  # of the bias, rad2/s2
        self.noise = 0.0  # variance of one sample, rad2/s2
        self._rested_s, self._samples = 0.0, 0
        self._other: Bias | None = None  # from consecutive samples that contradict this one

    @property
    def is_known(self) -> bool:
        """Whether the robot has stood still long enough to determine the bias."""
        return self._rested_s >= LEARNING_TIME_S

    def drift(self, dt: float) -> None:
        self.variance += BIAS_RANDOM_WALK * BIAS_RANDOM_WALK * dt

    def update_at_rest(self, rate: float, variance: float, dt: float) -> bool:
        """Update the bias with a sample of wheels at rest; return False if the robot turns.

        `variance` is as the gyro declares it, rad2/s2, or 0.
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
        # Welford's method. False: the sample shows a turn.
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
