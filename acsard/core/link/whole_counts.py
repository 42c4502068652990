"""Recovers whole encoder counts from the speeds of a plain line, if the counts per turn are known.

Firmware that divides n counts by a time T reports the speeds n a / T, with the angle a of a count
and one T for all wheels. The host knows T only to a few ms: at 16 counts a turn, 30 % of T are 30 %
of 0.4 rad. But n is whole, so the search tries the n of the fastest wheel from the one nearest to
the host's T until the counts of the other wheels are whole, too.
"""

from __future__ import annotations

import math

from acsard.core.link.codec import Motors

ROUNDING = 0.0052  # of a speed with two decimals (0.005 rad/s), with a small margin

MAX_TRIES = 16  # of n for a line, because the time of a control step is bounded

# That random speeds look like whole counts; it grows with each try. Above it, they prove nothing.
MAX_CHANCE = 0.05

# Counts between the number computed by the host's estimate and a whole one, where the speeds alone
# prove nothing (fine encoders), or to see whether a missing line is included.
MAX_COUNT_ERROR = 0.3

MAX_TIME_ERROR, MAX_TIME_ERROR_S = 0.6, 0.005  # of the host's estimate: relative, plus s

# Share of an error that the next estimate carries. With 1, clocks that differ by 0.5 % add up.
MAX_CARRIED_ERROR = 0.95

# Time since the line before, as a share of the firmware's counting time. Firmware that is asked
# very soon has no new counts and repeats its speeds; from this share on it does not.
REPEATED_FRACTION = 0.65

# Below the first share it does. In between, it does if the speeds are not whole counts, or if their
# time differs from the host's by that of so many counts of the fastest wheel.
REPEATED_LIMIT, REPEATED_COUNT_ERROR = 0.45, 0.25

# Mean error of the host's time in counts, above which the nearest number is often wrong; a random
# time has 0.25, and 96 counts a turn behind an adapter of 16 ms have this. Gain of the mean.
MAX_MEAN_ERROR, MEAN_GAIN = 0.2, 0.025

# Gain of `_doubt` and `_cover`. Once `_doubt` reaches the share, no line counts as whole counts.
SHARE_GAIN, MAX_BAD_SHARE = 0.1, 0.3


class WholeCounts:
    """Recovers whole encoder counts from the speeds of four wheels, line by line.

    If T is longer than the host's estimate, the next estimate is reduced by most of the difference.
    So the next line corrects a wrong n, and no time is lost or counted twice, even with fine
    encoders, where n cannot be found. After one missing line, the speeds fit T since its reply if
    that was lost, or T since the last good line if its command was. Firmware that filters its
    speeds or times edges is detected.
    """

    def __init__(self, counts: int) -> None:
        self.angle = math.tau / counts if counts else 0.0  # rad of one count, 0 if unknown
        self.forget()

    def forget(self) -> None:
        # s added to the next estimate, positive if the last sample was taken earlier than
        # estimated; s over which the firmware last counted.
        self._apart = self._period = 0.0
        self._run = 0  # lines with recovered counts in a row
        self._before: Motors = (0.0, 0.0, 0.0, 0.0)
        self.covers_gap = False  # the last line includes the counts of the missing line before it
        self._cover = 0.0  # share of the lines after a missing one that do, 0 to 1, where it shows
        # Lines that are not whole counts; error of the host's time in counts of the fastest wheel.
        self._doubt = self._unsure = 0.0

    def pause(self) -> None:
        """Carry no error to the next estimate: the last line does not show its counting time."""
        self._apart, self._run = 0.0, 0

    @property
    def believed(self) -> bool:
        """Whether the counts per turn are known, and few recent lines contradict whole counts."""
        return self.angle > 0.0 and self._doubt < MAX_BAD_SHARE

    def turned(self, speeds: Motors, elapsed_s: float, gap: float = 0.0) -> Motors | None:
        """Return the angle of each wheel since the previous line, rad, if possible as counts.

        Otherwise it is speed times time. Return None if the firmware has no whole counts, or if the
        wheels turn below the rounding. `elapsed_s` is the host's estimate since the previous line,
        received or not, and `gap` the time from the last good line to a missing one, s. With
        `covers_gap` the angles include it.
        """
        self.covers_gap = False
        before, self._before = self._before, speeds
        a, b, c, d = speeds
        fastest = max(a, b, c, d, -a, -b, -c, -d)
        if fastest <= ROUNDING:
            # The line does not show the firmware's time, so the host's time is the best available.
            self.pause()
            return speeds if fastest == 0.0 else None
        expected_s = elapsed_s + self._apart
        number, confirmed = self._number(speeds, fastest, expected_s)
        if gap:
            longer_s = expected_s + gap
            longer, proved = self._number(speeds, fastest, longer_s)
            fits = self._fits(number, fastest, expected_s), self._fits(longer, fastest, longer_s)
            if (proved and fits == (False, True)) or (confirmed and fits == (True, False)):
                self._cover += SHARE_GAIN * (fits[1] - self._cover)
                self.covers_gap = fits[1]
            else:
                self.covers_gap = self._cover > 0.5 and gap < 1.5 * elapsed_s
            if self.covers_gap:
                number, confirmed, expected_s = longer, proved, longer_s
        period = number * self.angle / fastest
        if (
            self.believed
            and speeds == before
            and expected_s < REPEATED_FRACTION * self._period
            and (
                not number
                or expected_s < REPEATED_LIMIT * self._period
                or abs(expected_s - period) > REPEATED_COUNT_ERROR * self.angle / fastest
            )
        ):
            self._apart = expected_s
            return 0.0, 0.0, 0.0, 0.0
        if confirmed is not None:
            # Only the other wheels can prove or refute whole counts.
            self._doubt += SHARE_GAIN * ((not confirmed) - self._doubt)
        if not self.believed:
            self.pause()
            self.covers_gap = False
            return None
        if number and confirmed is None:
            off = abs(expected_s - period) * fastest / self.angle
            self._unsure += MEAN_GAIN * (off - self._unsure)
        if not number or (confirmed is None and self._unsure > MAX_MEAN_ERROR):
            self.pause()
            self._period = expected_s
            return a * expected_s, b * expected_s, c * expected_s, d * expected_s
        # After the first line, the error comes from two sample times, so half of it is carried.
        self._run += 1
        share = min(MAX_CARRIED_ERROR, self._run / (self._run + 1))
        self._period, self._apart = period, share * (expected_s - period)
        if abs(expected_s - period) <= period * ROUNDING / fastest:
            self._apart = 0.0  # the rounding of the speeds explains the difference
        size, count = self.angle, period / self.angle
        return (
            round(a * count) * size,
            round(b * count) * size,
            round(c * count) * size,
            round(d * count) * size,
        )

    def _fits(self, number: int, fastest: float, expected_s: float) -> bool:
        return abs(number - expected_s * fastest / self.angle) <= MAX_COUNT_ERROR

    def _number(self, speeds: Motors, fastest: float, expected_s: float) -> tuple[int, bool | None]:
        # The count of the fastest wheel (0 if unknown), and whether the speeds are counts: True and
        # False are certain. `expected_s` is the host's estimate, corrected by the last error.
        count = fastest / self.angle
        exact = expected_s * count  # counts if the host's time were right
        room = (MAX_TIME_ERROR * expected_s + MAX_TIME_ERROR_S) * count
        number = max(1, round(exact))
        if abs(number - exact) > room:
            return 0, False
        shares = {abs(speed) / fastest for speed in speeds}
        shares -= {0.0, 1.0}
        if not shares:
            return number, None
        # With the share s of the fastest speed, s n is wrong by up to (1 + s) n rounding errors.
        error = ROUNDING / fastest
        step, chance = 1 if exact > number else -1, 0.0
        for _ in range(MAX_TRIES):
            if number > 0:
                if abs(number - exact) > room:
                    return 0, False
                by_chance = 1.0
                for share in shares:
                    by_chance *= min(1.0, 2 * error * number * (1 + share))
                chance += by_chance
                fits = True
                for share in shares:
                    whole = share * number
                    if abs(whole - round(whole)) > error * number * (1 + share):
                        fits = False
                        break
                if chance > MAX_CHANCE:
                    # If the firmware divides by a round period, the host's time alone agrees.
                    return (number if fits and abs(number - exact) <= MAX_COUNT_ERROR else 0), None
                if fits:
                    return number, True
            number += step
            step = -step - (1 if step > 0 else -1)
        return 0, None
