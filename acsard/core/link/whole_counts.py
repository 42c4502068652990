"""Recovers whole encoder counts from the speeds of a plain line, if the counts per turn are known.

A firmware that divides counts by time reports n a / T for a wheel that made n counts of the angle a
in T s. The time T since its sample before is the same for all four wheels, but the host knows it
only to a few ms. With a coarse encoder that error turns the robot: one count of 16 a turn is 0.4
rad of the wheel, and 30 % of T is 30 % of that. A count, however, is a whole number:

1. Each number n of counts of the fastest wheel means a time T = n a / speed. The candidates are
   tried from the one nearest to the host's estimate of T.
2. The first candidate that makes the counts of the other wheels whole as well is right.
3. The error of the host's time is carried to the next line: a sample that was later than the host
   believed leaves less time until the next one. A wrong candidate is thereby made good.

If the host's time shows the number of counts too badly, as with fine encoders, the line is its
speed times its time. That time includes the part that the lines before have left over, so that no
time is lost and none counts twice.

The speeds of a firmware that filters, or that measures the time between two edges, are not whole
counts. Such lines are noticed by their other wheels, and the caller then uses speed times time.
"""

from __future__ import annotations

import math

from acsard.core.link.codec import Motors

ROUNDING = 0.0052
"""Largest rounding error of a speed in two decimals, rad/s."""

MOST_TRIES = 16
"""Candidates that are tried at most, which bounds the time of a control step."""

BY_CHANCE = 0.05
"""Largest probability that speeds at random fit one of the candidates."""

EXACT = 0.3
"""Counts by which the host's time may differ from that of fine encoders' whole counts."""

WIDE, WIDE_S = 0.6, 0.005
"""Largest difference between the firmware's time and the host's: a share of it, plus s."""

KEPT = 0.95
"""Largest share of the host's time error that is carried to the next line. Two clocks that differ
by 0.5 % would otherwise drift apart for ever."""

REPEATED = 0.65
"""Share of the firmware's last time. A line with the same speeds after less time repeats the line
before: firmware that is asked again too soon has no new counts."""

SOON, OFF = 0.45, 0.25
"""Share of the firmware's last time below which such a line is a repetition in any case. Above it,
its time must also differ by so many counts from that of whole counts."""

UNSURE, SLOW = 0.2, 0.025
"""Mean error of the host's time, in counts of the fastest wheel, above which the nearest number of
counts is often wrong (at random it is 0.25), and the gain of its filter. It is as large for 96
counts behind a USB adapter that batches lines for 16 ms."""

GAIN, DOUBTFUL = 0.1, 0.3
"""Gain of the filter for the share of lines that are not whole counts, and the share from which on
no line is believed to be."""


class WholeCounts:
    """Whole counts of four wheels, line by line."""

    def __init__(self, counts: int) -> None:
        """Start; `counts` are the encoder counts per wheel turn, 0 if unknown."""
        self.angle = math.tau / counts if counts else 0.0
        """Angle of one count, rad, 0 if unknown."""
        self.forget()

    def forget(self) -> None:
        """Start over: the board may be another one."""
        self._apart = self._period = 0.0
        """By how much the last sample was earlier than the host believed, and the firmware's last
        time, s."""
        self._run = 0
        """Number of lines with counts since the last one without."""
        self._before: Motors = (0.0, 0.0, 0.0, 0.0)
        self._doubt = self._unsure = 0.0
        """Filtered share of the lines that are not whole counts, and filtered error of the host's
        time, in counts."""

    def pause(self) -> None:
        """Note a line by which the time of its sample remains as unknown as the host's time."""
        self._apart, self._run = 0.0, 0

    @property
    def believed(self) -> bool:
        """Whether the firmware reports whole counts, as far as its lines show."""
        return self.angle > 0.0 and self._doubt < DOUBTFUL

    def turned(self, speeds: Motors, own: float) -> Motors | None:
        """Return how far each wheel turned in the `own` s of this line, rad.

        Return None if the firmware does not report whole counts, or too slow a speed.
        """
        before, self._before = self._before, speeds
        a, b, c, d = speeds
        fastest = max(a, b, c, d, -a, -b, -c, -d)
        if fastest <= ROUNDING:
            # The firmware's time stays unknown, so the host's is as good as it gets.
            self.pause()
            return speeds if fastest == 0.0 else None
        want = own + self._apart
        number, shown = self._number(speeds, fastest, want)
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
            return None
        if number and shown is None:
            off = abs(want - period) * fastest / self.angle
            self._unsure += SLOW * (off - self._unsure)
        if not number or (shown is None and self._unsure > UNSURE):
            # Speed times time, with the time that the lines before have left over.
            self.pause()
            self._period = want
            return a * want, b * want, c * want, d * want
        # The first time is between two samples of which the host knows neither better.
        self._run += 1
        kept = min(KEPT, self._run / (self._run + 1))
        self._period, self._apart = period, kept * (want - period)
        if abs(want - period) <= period * ROUNDING / fastest:
            self._apart = 0.0  # nothing but the rounding of the speeds
        size, count = self.angle, period / self.angle
        return (
            round(a * count) * size,
            round(b * count) * size,
            round(c * count) * size,
            round(d * count) * size,
        )

    def _number(self, speeds: Motors, fastest: float, want: float) -> tuple[int, bool | None]:
        """Return the counts of the fastest wheel, 0 if the line does not show them.

        Also return whether the speeds prove that they are whole counts, or that they are not. None
        means that they prove nothing.
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
        # A share s of n counts is off by (1 + s) n times the rounding error of the fastest speed.
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
                    # The host's time agrees with the counts if the firmware divides by a round one.
                    return (number if fits and abs(number - exact) <= EXACT else 0), None
                if fits:
                    return number, True
            number += step
            step = -step - (1 if step > 0 else -1)
        return 0, None
