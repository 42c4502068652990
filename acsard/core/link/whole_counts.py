"""Recovers whole encoder counts from the speeds of a plain line, if the counts per turn are known.

Let a be the angle of one count in rad, and T the time in s in which a wheel made n counts. Firmware
that divides counts by time reports the speed n a / T. T is the same for all four wheels, but the
host knows it only to a few ms. With a coarse encoder, this error makes the heading wrong. At 16
counts a turn, the wheel rolls 0.4 rad per count, and an error of 30 % in T is 30 % of that angle.
However, n is a whole number, so T can be found from the speeds:

1. Each possible n of the fastest wheel implies a time T = n a / speed. The search starts at the n
   whose T is nearest to the host's estimate.
2. The search ends at the first n with which the counts of the other wheels are whole numbers too.
3. If T is longer than the host's estimate, the board took this sample later than the host thought,
   so less time is left until the next sample. Therefore the host's estimate for the next line is
   reduced by most of the difference, and raised if T is shorter. This also corrects the error in
   the next line if n was wrong.

With fine encoders, the host's estimate is too inaccurate to find n. Then the angle of each wheel is
its speed times the host's estimate, which includes the correction from the previous line. So no
time is lost or counted twice.

If the previous line is missing, there are two cases. If the board answered and its reply was lost,
T covers only the time since that reply. If the command was lost, the board did not answer, and T
covers the whole time since the last good line. The speeds are whole counts for only one of these
two times. If a line does not show which case applies, the module assumes the case of most earlier
lines. If more than one line is missing, it assumes the first case.

Some firmware filters its speeds, or measures the time between two encoder edges. Its speeds are not
whole counts. The module detects this, and the caller then uses speed times time.
"""

from __future__ import annotations

import math

from acsard.core.link.codec import Motors

ROUNDING = 0.0052
"""Largest rounding error of a speed with two decimals (0.005 rad/s), with a small margin."""

MAX_TRIES = 16
"""Largest number of different values of n, the counts of the fastest wheel, that are tried for a
line. This limit bounds the time of a control step."""

MAX_CHANCE = 0.05
"""Largest accepted probability that random speeds look like whole counts. The probability grows
with each number of counts that is tried for a line. If the probability exceeds this limit, speeds
that look like whole counts prove nothing."""

MAX_COUNT_ERROR = 0.3
"""Largest accepted difference between a whole number of counts and a computed number. The computed
number follows from the speed and the host's estimate of the time between two samples. This limit
applies if the speeds alone prove nothing, as with fine encoders. It also helps to decide whether a
line includes the counts of the missing line before it."""

MAX_TIME_ERROR, MAX_TIME_ERROR_S = 0.6, 0.005
"""Largest assumed error of the host's estimate of the time between two samples: the estimate times
`MAX_TIME_ERROR`, plus `MAX_TIME_ERROR_S` s."""

MAX_CARRIED_ERROR = 0.95
"""Largest share of an error that is added to the estimate for the next line. The error is that of
the host's estimate of the time between two samples. The share must be below 1. If the share were 1
and the clocks of the host and the board differed by 0.5 %, the sum of the errors would grow
forever."""

REPEATED_FRACTION = 0.65
"""Limit from which on a line with unchanged speeds is not a repetition of the previous line. The
limit applies to the time since the previous line, divided by the time over which the firmware last
counted. Firmware that is asked again very soon has no new counts, so it repeats the speeds of the
previous line."""

REPEATED_LIMIT, REPEATED_COUNT_ERROR = 0.45, 0.25
"""Limits for a line with unchanged speeds. Let q be the time since the previous line, divided by
the time over which the firmware last counted. If q is less than `REPEATED_LIMIT`, the line is a
repetition of the previous line. If q lies between `REPEATED_LIMIT` and `REPEATED_FRACTION`, the
line is a repetition in two cases. Either its speeds are not whole counts. Or the time that its
counts imply differs from the host's estimate by more than the time of `REPEATED_COUNT_ERROR` counts
of the fastest wheel."""

MAX_MEAN_ERROR, MEAN_GAIN = 0.2, 0.025
"""`MAX_MEAN_ERROR` is a limit for the mean error of the host's estimate of the time between two
samples, in counts of the fastest wheel. Above this limit, the nearest whole number of counts is
often wrong. A random time has a mean error of 0.25. An encoder with 96 counts a turn reaches
`MAX_MEAN_ERROR` behind a USB adapter that batches lines for 16 ms. `MEAN_GAIN` is the gain of the
filter for the mean."""

SHARE_GAIN, MAX_BAD_SHARE = 0.1, 0.3
"""`SHARE_GAIN` is the gain of the filters for two shares: the share of lines whose speeds are not
whole counts, and the share of lines that include the counts of the missing line before them. If the
first share reaches `MAX_BAD_SHARE`, no line is treated as whole counts."""


class WholeCounts:
    """Recovery of whole encoder counts from the speeds of four wheels, line by line."""

    def __init__(self, counts: int) -> None:
        """Start before the first line.

        `counts` is the number of encoder counts per wheel turn, 0 if unknown.
        """
        self.angle = math.tau / counts if counts else 0.0
        """Angle of one encoder count, rad, 0 if unknown."""
        self.forget()

    def forget(self) -> None:
        """Forget all earlier lines, because they may be those of another board."""
        self._apart = self._period = 0.0
        """`_apart` is the time, s, that is added to the host's estimate of the time until the next
        sample. It is positive if the board took the last sample earlier than the host estimated.
        `_period` is the time, s, over which the firmware last counted."""
        self._run = 0
        """Number of lines with recovered counts since the last line without recovered counts."""
        self._before: Motors = (0.0, 0.0, 0.0, 0.0)
        self.covers_gap = False
        """Whether the last line includes the counts of the missing line before it."""
        self._cover = 0.0
        """Filtered share of lines that include the counts of the missing line before them, 0 to 1.
        It is computed only from lines that follow a missing line and show whether they include its
        counts."""
        self._doubt = self._unsure = 0.0
        """`_doubt` is the filtered share of the lines whose speeds are not whole counts. `_unsure`
        is the filtered error of the host's estimate of the time, in counts of the fastest wheel."""

    def pause(self) -> None:
        """Do not add the error of the last estimated time between two samples to the next estimate.
        The caller does this if the last line does not show the time over which the firmware
        counted.
        """
        self._apart, self._run = 0.0, 0

    @property
    def believed(self) -> bool:
        """Whether the counts per turn are known, and few recent lines contradict whole counts."""
        return self.angle > 0.0 and self._doubt < MAX_BAD_SHARE

    def turned(self, speeds: Motors, elapsed_s: float, gap: float = 0.0) -> Motors | None:
        """Return the angle by which each wheel turned since the previous line, rad.

        The angles are whole counts. If the line does not show the counts, the angles are speed
        times time. Return None if the firmware does not report whole counts. Also return None if
        the wheels turn, but no speed exceeds its rounding error.

        `speeds` are in rad/s. `elapsed_s` is the host's estimate of the time since the previous
        line, whether or not the host received that line. If that line is missing, `gap` is the time
        from the last good line to the missing line, s. Otherwise `gap` is 0. If the call sets
        `covers_gap` to True, the angles also include the motion during `gap`.
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
            # Speed times time. The time includes the time carried from earlier lines.
            self.pause()
            self._period = expected_s
            return a * expected_s, b * expected_s, c * expected_s, d * expected_s
        # After the first line, the error comes from two sample times in equal parts, so only half
        # of it is carried. With each further line the share grows.
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
        """Return the count n of the fastest wheel (0 if unknown), and whether speeds are counts.

        The second value is True if the speeds are certainly whole counts, False if they certainly
        are not, and None if it is not certain. `fastest` is the largest absolute value
        in `speeds`, rad/s. `expected_s` is the host's estimate of the time between the two samples,
        corrected by the error in the previous line.
        """
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
        # A wheel with the share s of the fastest speed makes s n counts. The computed s n is wrong
        # by up to (1 + s) n times the relative rounding error of the fastest speed.
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
                    # The speeds prove nothing. If the firmware divides by a round period, then the
                    # host's time alone agrees with the counts.
                    return (number if fits and abs(number - exact) <= MAX_COUNT_ERROR else 0), None
                if fits:
                    return number, True
            number += step
            step = -step - (1 if step > 0 else -1)
        return 0, None
