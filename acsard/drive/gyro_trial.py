"""Is this a gyro, and does it say rad/s about an axis that points up? The first turn tells.

A gyro that is mounted upside down, counts in degrees or is not read at all says another turn than
the wheels do, and so does a gyro beside wheels that slip. Which of them is wrong is told by which
has been right before: one that has never agreed with the wheels in a turn is no gyro yet. Wheels
that skid turn the robot by less than they roll, so that they agree within wide bounds.
"""

from __future__ import annotations

from typing import Literal

LEAST_RATE = 0.1
"""rad/s by the wheels, from which on a line to the other side is another turn, and no count more or
less."""

SLOWEST, STRETCH_S = 0.05, 0.5
"""rad/s by the wheels, in the mean over so many s; slower is no turn: of unequal tyres the wheels
say one on a straight, beside which below `LEAST_RATE` no gyro is dead that says nothing."""

PROPORTIONS = (0.25, 2.5)
"""Between these a robot turns per turn of its wheels, whatever it skids."""

PROVED, REFUTED = 0.1, 0.4
"""rad in one direction by the wheels in which a gyro proves itself, or does not: it may be late."""

REFUTED_S = 0.3
"""s of turning before it is refuted: no gyro is as late as that."""

DEGREES = (15.0, 150.0)
"""57.3 as wide as the proportions."""

Verdict = Literal["none yet", "good", "reversed", "in degrees", "dead", "not believed"]


class Trial:
    """Takes both turns line by line until the gyro is proved; one that is refuted may be later."""

    def __init__(self) -> None:
        self.verdict: Verdict = "none yet"
        self._wheels = self._gyro = self._seconds = 0.0
        self._stretch = self._stretch_s = self._stretch_gyro = 0.0
        """rad by the wheels, s, and rad by the gyro of this stretch;"""
        self._fast = self._fast_gyro = 0.0
        """rad by both of those that were fast enough for a gyro to be dead."""

    @property
    def open(self) -> bool:
        """It has not proved itself."""
        return self.verdict != "good"

    def add(self, wheels: float, gyro: float, dt: float, certain: bool = True) -> None:
        """A line: rad that wheels and gyro say it turned in its `dt` s.

        Without a certain bias it is only seen that it tells degrees.
        """
        self._stretch += wheels
        self._stretch_gyro += gyro
        self._stretch_s += dt
        if self._stretch_s >= STRETCH_S:
            if abs(self._stretch) < SLOWEST * self._stretch_s:
                self._begin()
            if abs(self._stretch) >= LEAST_RATE * self._stretch_s:
                self._fast += self._stretch
                self._fast_gyro += self._stretch_gyro
            self._stretch = self._stretch_s = self._stretch_gyro = 0.0
        if wheels * self._wheels < 0.0 and abs(wheels) >= LEAST_RATE * dt:
            # Of a turn to the other side a late gyro still tells the one before.
            self._begin()
            return
        self._wheels += wheels
        self._gyro += gyro
        self._seconds += dt if abs(wheels) >= SLOWEST * dt else 0.0
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
        """In turns that are no straight of unequal tyres, this one among them."""
        fast, gyro = self._fast, self._fast_gyro
        if abs(self._stretch) >= LEAST_RATE * self._stretch_s:
            fast, gyro = fast + self._stretch, gyro + self._stretch_gyro
        return abs(fast) >= REFUTED and abs(gyro) < PROPORTIONS[0] * abs(fast)

    def _verdict(self, ratio: float) -> Verdict:
        least, most = PROPORTIONS
        if abs(self._wheels) >= PROVED and least <= ratio <= most:
            return "good"
        if abs(self._wheels) < REFUTED or self._seconds < REFUTED_S:
            return "none yet"
        return _named(ratio)


def _named(ratio: float) -> Verdict:
    """What is wrong with a gyro that says so much per turn of the wheels."""
    least, most = PROPORTIONS
    if DEGREES[0] <= abs(ratio) <= DEGREES[1]:
        return "in degrees"
    if -most <= ratio <= -least:
        return "reversed"
    return "dead" if abs(ratio) < least else "not believed"
