"""Recovers whole encoder counts from the speeds of a plain line, if the counts per turn are known.

Let a be the angle of one count, and T the time in s since the previous sample. For a wheel that
made n counts, firmware that divides counts by time reports the speed n a / T. T is the same for all
four wheels, but the host knows it only to a few ms. With a coarse encoder that error falsifies the
heading: at 16 counts a turn, one count is 0.4 rad of the wheel, and an error of 30 % in T is an
error of 30 % of that angle. However, n is a whole number:

1. Each candidate n for the fastest wheel implies a time T = n a / speed. The search starts at the n
   whose T is nearest to the host's estimate.
2. The first n that makes the counts of the other wheels whole too is accepted.
3. The error of the host's time is carried to the next line: if a sample was later than the host
   believed, less time is left until the next sample. The carried time also corrects a wrong n.

With fine encoders, the host's time is too inaccurate to find n. Then the angle of each wheel is its
speed times the host's time. That time includes the time carried from earlier lines, so no time is
lost or counted twice.

If the previous line is missing, either the reply or the command was lost. If the reply was lost, T
covers only the time since that reply. If the command was lost, T covers the whole time since the
last good line. The speeds are then whole counts in the longer time and not in the shorter one. A
line that shows neither case is treated like most other lines, but only if one line is missing.

Some firmware filters its speeds, or measures the time between two encoder edges. Its speeds are not
whole counts. The module detects this because the counts of the other wheels are not whole. The
caller then uses speed times time.
"""

from __future__ import annotations

import math

from acsard.core.link.codec import Motors

ROUNDING = 0.0052
"""Largest rounding error of a speed with two decimals, rad/s."""

MOST_TRIES = 16
"""Largest number of candidates n that are tried, which bounds the time of a control step."""

BY_CHANCE = 0.05
"""Largest accepted probability that random speeds fit one of the candidates n tried so far.

Above it, a fit proves nothing.
"""

EXACT = 0.3
"""Largest accepted difference between n and the count that the host's time implies, in counts.

It applies if a fit proves nothing, as with fine encoders. It also decides whether a line covers the
time of a missing one.
"""

WIDE, WIDE_S = 0.6, 0.005
"""Largest difference between the firmware's time and the host's.

It is `WIDE` times the host's time, plus `WIDE_S` seconds.
"""

KEPT = 0.95
"""Largest share of the host's time error that is carried to the next line. With a share of 1, the
carried error of two clocks that differ by 0.5 % would grow for ever."""

REPEATED = 0.65
"""After less than this share of the firmware's last T, a line with unchanged speeds may repeat the
previous line. Firmware that is asked again too soon has no new counts."""

SOON, OFF = 0.45, 0.25
"""Limits for a line with unchanged speeds. After less than `SOON` times the firmware's last T, it
is always a repetition. Between `SOON` and `REPEATED` times the last T, it is a repetition only if
it shows no whole counts, or if the host's time differs from that of whole counts by more than `OFF`
counts."""

UNSURE, SLOW = 0.2, 0.025
"""`UNSURE` is the mean error of the host's time, in counts of the fastest wheel, above which the
nearest n is often wrong. A random time has a mean error of 0.25. An encoder with 96 counts a turn
reaches `UNSURE` behind a USB adapter that batches lines for 16 ms. `SLOW` is the gain of the filter
for this error."""

GAIN, DOUBTFUL = 0.1, 0.3
"""`GAIN` is the gain of the filter for the share of lines that are not whole counts. From the share
`DOUBTFUL` on, no line is treated as whole counts."""


class WholeCounts:
    """The recovery of the whole counts of four wheels, line by line."""

    def __init__(self, counts: int) -> None:
        """Start. `counts` is the number of encoder counts per wheel turn, 0 if unknown."""
        self.angle = math.tau / counts if counts else 0.0
        """Angle of one count, rad, 0 if unknown."""
        self.forget()

    def forget(self) -> None:
        """Forget all earlier lines, because they may be those of another board."""
        self._apart = self._period = 0.0
        """`_apart` is how much earlier the last sample was than the host believed, s. `_period` is
        the firmware's last T, s."""
        self._run = 0
        """Number of lines with recovered counts since the last line without them."""
        self._before: Motors = (0.0, 0.0, 0.0, 0.0)
        self.covers_gap = False
        """Whether the last line covers the time of the missing line before it."""
        self._cover = 0.0
        """Filtered share of the lines that cover the time of the missing line before them, among
        the lines that show whether they do."""
        self._doubt = self._unsure = 0.0
        """`_doubt` is the filtered share of the lines that are not whole counts. `_unsure` is the
        filtered error of the host's time, in counts."""

    def pause(self) -> None:
        """Reset the carried time, because a line does not show the firmware's T."""
        self._apart, self._run = 0.0, 0

    @property
    def believed(self) -> bool:
        """Whether the firmware reports whole counts, as far as its lines show."""
        return self.angle > 0.0 and self._doubt < DOUBTFUL

    def turned(self, speeds: Motors, own: float, gap: float = 0.0) -> Motors | None:
        """Return the angle by which each wheel turned since the previous line, rad.

        Return None if the firmware does not report whole counts, or if no speed exceeds its
        rounding error. If all speeds are 0, the angles are 0 too.

        Args:
            speeds: The speeds in the line, rad/s.
            own: The host's estimate of the time since the previous line, s.
            gap: The time from the last good line to the missing previous line, s. 0 if none is
                missing.
        """
        self.covers_gap = False
        before, self._before = self._before, speeds
        a, b, c, d = speeds
        fastest = max(a, b, c, d, -a, -b, -c, -d)
        if fastest <= ROUNDING:
            # The line does not show the firmware's time, so the host's time is the best available.
            self.pause()
            return speeds if fastest == 0.0 else None
        want = own + self._apart
        number, shown = self._number(speeds, fastest, want)
        if gap:
            longer, proved = self._number(speeds, fastest, want + gap)
            fits = self._fits(number, fastest, want), self._fits(longer, fastest, want + gap)
            if (proved and fits == (False, True)) or (shown and fits == (True, False)):
                self._cover += GAIN * (fits[1] - self._cover)
                self.covers_gap = fits[1]
            else:
                self.covers_gap = self._cover > 0.5 and gap < 1.5 * own
            if self.covers_gap:
                number, shown, want = longer, proved, want + gap
        period = number * self.angle / fastest
        if (
            speeds == before
            and want < REPEATED * self._period
            and (
                not number
                or want < SOON * self._period
                or abs(want - period) > OFF * self.angle / fastest
            )
        ):
            self._apart = want
            return 0.0, 0.0, 0.0, 0.0
        if shown is not None:
            # Only the other wheels can prove or refute whole counts.
            self._doubt += GAIN * ((not shown) - self._doubt)
        if not self.believed:
            self.pause()
            self.covers_gap = False
            return None
        if number and shown is None:
            off = abs(want - period) * fastest / self.angle
            self._unsure += SLOW * (off - self._unsure)
        if not number or (shown is None and self._unsure > UNSURE):
            # Speed times time. The time includes the time carried from earlier lines.
            self.pause()
            self._period = want
            return a * want, b * want, c * want, d * want
        # After the first line, the error comes from two sample times in equal parts, so only half
        # of it is carried. With each further line the share grows.
        self._run += 1
        kept = min(KEPT, self._run / (self._run + 1))
        self._period, self._apart = period, kept * (want - period)
        if abs(want - period) <= period * ROUNDING / fastest:
            self._apart = 0.0  # the rounding of the speeds explains the difference
        size, count = self.angle, period / self.angle
        return (
            round(a * count) * size,
            round(b * count) * size,
            round(c * count) * size,
            round(d * count) * size,
        )

    def _fits(self, number: int, fastest: float, want: float) -> bool:
        """Return whether the host's time `want`, s, agrees with `number` counts of a wheel.

        `fastest` is the speed of that wheel, rad/s.
        """
        return abs(number - want * fastest / self.angle) <= EXACT

    def _number(self, speeds: Motors, fastest: float, want: float) -> tuple[int, bool | None]:
        """Return n, the counts of the fastest wheel, or 0 if the line does not show n.

        The second value is True if the speeds prove that they are whole counts, False if they prove
        the opposite, and None if they prove nothing.

        Args:
            speeds: The speeds in the line, rad/s.
            fastest: The largest absolute value of the speeds, rad/s.
            want: The host's estimate of T, with the carried time, s.
        """
        count = fastest / self.angle
        exact = want * count  # counts if the host's time were right
        room = (WIDE * want + WIDE_S) * count
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
        for _ in range(MOST_TRIES):
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
                if chance > BY_CHANCE:
                    # The speeds prove nothing. If the firmware divides by a round period, then the
                    # host's time alone agrees with the counts.
                    return (number if fits and abs(number - exact) <= EXACT else 0), None
                if fits:
                    return number, True
            number += step
            step = -step - (1 if step > 0 else -1)
        return 0, None
