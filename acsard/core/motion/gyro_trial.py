"""Tests in the first turn whether a gyro measures rad/s about an axis that points up.

One that is upside down, reads degrees or is disconnected disagrees in every turn, a good one only
when the wheels slip. So it is used after it has agreed with the wheels in one turn, within wide
limits, because skidding wheels roll further than the robot turns.
"""

from __future__ import annotations

from typing import Literal

# rad/s by the wheels: less may be one encoder count. A gyro that reads zero at it is dead.
MIN_TURN_RATE = 0.1

# Mean rate by the wheels, rad/s, over intervals of `STRETCH_S`, from which the robot turns.
MIN_MEAN_RATE, STRETCH_S = 0.05, 0.5

# Range of the true turn divided by the turn of the wheels, on any floor.
TURN_RATIO_RANGE = (0.25, 2.5)

# Least turns to one side by the wheels, rad, that can prove a gyro, and that can refute one. The
# second is larger, because the gyro may be late.
MIN_PROVING_TURN, MIN_REFUTING_TURN = 0.1, 0.4

MIN_REFUTING_TURN_S = 0.3  # no gyro has such a delay

DEGREES_RATIO_RANGE = (15.0, 150.0)  # in degrees; 57 without slip and errors

Verdict = Literal["none yet", "good", "reversed", "in degrees", "dead", "not believed"]


class Trial:
    """Compares a gyro with the wheels until it is proven.

    A `verdict` that refutes it is not the last one.
    """

    def __init__(self) -> None:
        self.verdict: Verdict = "none yet"
        self._wheels = self._gyro = self._seconds = 0.0
        # Sums of the present interval: wheels, rad; s; gyro, rad.
        self._stretch = self._stretch_s = self._stretch_gyro = 0.0
        # rad by wheels and gyro, in intervals of `MIN_TURN_RATE`.
        self._fast = self._fast_gyro = 0.0

    @property
    def open(self) -> bool:
        return self.verdict != "good"

    def add(self, wheels: float, gyro: float, dt: float, certain: bool = True) -> None:
        """Compare a line of `dt` s, rad by wheels and gyro, and update `verdict`.

        With an unknown bias (not `certain`), it can only become "in degrees".
        """
        self._stretch += wheels
        self._stretch_gyro += gyro
        self._stretch_s += dt
        if self._stretch_s >= STRETCH_S:
            if abs(self._stretch) < MIN_MEAN_RATE * self._stretch_s:
                self._begin()
            if abs(self._stretch) >= MIN_TURN_RATE * self._stretch_s:
                self._fast += self._stretch
                self._fast_gyro += self._stretch_gyro
            self._stretch = self._stretch_s = self._stretch_gyro = 0.0
        if wheels * self._wheels < 0.0 and abs(wheels) >= MIN_TURN_RATE * dt:
            # At the start of a turn to the other side, a late gyro still reports the previous turn.
            self._begin()
            return
        self._wheels += wheels
        self._gyro += gyro
        self._seconds += dt if abs(wheels) >= MIN_MEAN_RATE * dt else 0.0
        if self._wheels == 0.0:
            return
        verdict = self._verdict(self._gyro / self._wheels)
        if verdict == "dead" and not self._says_nothing():
            verdict = "none yet"
        if verdict != "none yet" and (certain or verdict == "in degrees"):
            self.verdict = verdict

    def _begin(self) -> None:
        self._wheels = self._gyro = self._seconds = self._fast = self._fast_gyro = 0.0

    def _says_nothing(self) -> bool:
        fast, gyro = self._fast, self._fast_gyro
        if abs(self._stretch) >= MIN_TURN_RATE * self._stretch_s:
            fast, gyro = fast + self._stretch, gyro + self._stretch_gyro
        return abs(fast) >= MIN_REFUTING_TURN and abs(gyro) < TURN_RATIO_RANGE[0] * abs(fast)

    def _verdict(self, ratio: float) -> Verdict:
        least, most = TURN_RATIO_RANGE
        if abs(self._wheels) >= MIN_PROVING_TURN and least <= ratio <= most:
            return "good"
        if abs(self._wheels) < MIN_REFUTING_TURN or self._seconds < MIN_REFUTING_TURN_S:
            return "none yet"
        return _named(ratio)


def _named(ratio: float) -> Verdict:
    least, most = TURN_RATIO_RANGE
    if DEGREES_RATIO_RANGE[0] <= abs(ratio) <= DEGREES_RATIO_RANGE[1]:
        return "in degrees"
    if -most <= ratio <= -least:
        return "reversed"
    return "dead" if abs(ratio) < least else "not believed"
