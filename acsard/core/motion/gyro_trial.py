"""Tests in the first turn whether a gyro measures rad/s about an axis that points up.

A gyro that is mounted upside down, reads degrees or is disconnected disagrees with the wheels in
every turn. A good gyro disagrees with them only in a turn in which the wheels slip. So a gyro is
used after it has agreed with the wheels in one turn. The limits for this agreement are wide,
because skidding wheels roll further than the robot turns.
"""

from __future__ import annotations

from typing import Literal

MIN_TURN_RATE = 0.1
"""Turn rate according to the wheels, rad/s, with two uses. A feedback line in the opposite
direction begins a new turn only from this rate on, because a lower rate may come from a single
encoder count. A gyro that reads zero is called dead only from this rate on, because wheels with
unequal tires report a lower rate while the robot drives straight."""

MIN_MEAN_RATE, STRETCH_S = 0.05, 0.5
"""`MIN_MEAN_RATE` is the smallest mean turn rate according to the wheels that counts as a turn,
rad/s. `STRETCH_S` is the duration of the intervals over which the mean is taken, s."""

TURN_RATIO_RANGE = (0.25, 2.5)
"""Range of the ratio of the robot's true turn to its turn according to the wheels. On any floor,
the ratio is within this range."""

MIN_PROVING_TURN, MIN_REFUTING_TURN = 0.1, 0.4
"""Smallest turns to one side according to the wheels, rad. A turn of `MIN_PROVING_TURN` can prove
that the gyro is good, and a turn of `MIN_REFUTING_TURN` can show that it is not. The second one is
larger, because the gyro may be late."""

MIN_REFUTING_TURN_S = 0.3
"""Shortest time for which the robot must turn before the gyro can be refuted, s. No gyro has a
delay as long as this."""

DEGREES_RATIO_RANGE = (15.0, 150.0)
"""Range of the ratio of the gyro's turn to the wheels' turn if the gyro reads degrees. Without slip
and errors, the ratio is 57."""

Verdict = Literal["none yet", "good", "reversed", "in degrees", "dead", "not believed"]


class Trial:
    """Compares a gyro with the wheels until the gyro is proven.

    `verdict` is the result so far. A gyro that was refuted can still be proven later, so a
    refutation does not end the comparison.
    """

    def __init__(self) -> None:
        self.verdict: Verdict = "none yet"
        self._wheels = self._gyro = self._seconds = 0.0
        self._stretch = self._stretch_s = self._stretch_gyro = 0.0
        """Sums over the present interval of `STRETCH_S`: the turn according to the wheels, rad; the
        duration, s; and the turn according to the gyro, rad."""
        self._fast = self._fast_gyro = 0.0
        """Turns according to wheels and gyro, rad, over all intervals in which the mean turn rate
        was at least `MIN_TURN_RATE`."""

    @property
    def open(self) -> bool:
        """Whether the trial goes on. It ends when the gyro is proven."""
        return self.verdict != "good"

    def add(self, wheels: float, gyro: float, dt: float, certain: bool = True) -> None:
        """Compare the turns of gyro and wheels in a feedback line of `dt` s, and update `verdict`.

        `wheels` and `gyro` are the turns of the robot in this line according to wheels and gyro,
        rad. `certain` is false if the bias of the gyro is unknown. The verdict can then only change
        to "in degrees".
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
    """Return the verdict on a gyro whose turn is `ratio` times the wheels' turn."""
    least, most = TURN_RATIO_RANGE
    if DEGREES_RATIO_RANGE[0] <= abs(ratio) <= DEGREES_RATIO_RANGE[1]:
        return "in degrees"
    if -most <= ratio <= -least:
        return "reversed"
    return "dead" if abs(ratio) < least else "not believed"
