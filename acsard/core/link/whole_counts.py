"""Recovers whole encoder counts from the speeds of a plain line, if the counts per turn are known.

Firmware that divides n counts by a time T reports the speeds n a / T, with the angle a of a count
and one T for all wheels. The host knows T only to a few ms: at 16 counts a turn, 30 % of T are 30 %
of 0.4 rad. But n is whole, so the search tries the n of the fastest wheel from the one nearest to
the host's T until the counts of the other wheels are whole, too.
"""

from __future__ import annotations

from msgspec import Struct

from acsard.core.values import Wheels4

ROUNDING = 0.0052  # of a speed with two decimals (0.005 rad/s), with a small margin

MAX_TRIES = 16  # of n for a line, because the time of a control step is bounded

# That random speeds look like whole counts; it grows with each try. Above it, they prove nothing.
MAX_CHANCE = 0.05

# Error of the host's time, in counts of the fastest wheel, up to which it alone shows n.
MAX_COUNT_ERROR = 0.3

MAX_TIME_ERROR, MAX_TIME_ERROR_S = 0.6, 0.005  # of the host's estimate: relative, plus s

# Share of an error that the next estimate carries. With 1, clocks that differ by 0.5 % add up.
CARRIED_ERROR = 0.95

# Time since the line before, as a share of the firmware's counting time, below which it has no new
# counts yet and repeats its speeds.
REPEATED_FRACTION = 0.55

# Gain of `misfit`. Once it reaches the share, no line counts as whole counts.
MISFIT_GAIN, MAX_MISFIT = 0.1, 0.3

AT_REST: Wheels4 = (0.0, 0.0, 0.0, 0.0)


class WholeCounts(Struct):
    """Recovers whole encoder counts from the speeds of the wheels, line by line.

    If T is longer than the host's estimate, the next estimate is reduced by the difference. So the
    next line corrects a wrong n, and no time is lost or counted twice. Firmware that filters its
    speeds or times edges is detected.
    """

    # s that the next estimate carries, and in which the firmware last counted.
    carried: float = 0.0
    period: float = 0.0
    before: Wheels4 = AT_REST
    misfit: float = 0.0  # share of the last lines that are no whole counts
    covers_gap: bool = False  # the last line includes the counts of the missing line before it

    def turned(
        self, angle: float, speeds: Wheels4, elapsed: float, jitter: float, gap: float = 0.0
    ) -> Wheels4 | None:
        """Return the angle of each wheel since the previous line, rad, if possible as counts.

        Otherwise it is speed times time. Return None if the firmware has no whole counts, or if the
        wheels turn below the rounding. `elapsed` is the host's estimate since the previous line,
        received or not, s, `jitter` its error, and `gap` the time before it to the last good line.
        """
        before, self.before = self.before, speeds
        a, b, c, d = speeds
        fastest = max(a, b, c, d, -a, -b, -c, -d)
        if fastest <= ROUNDING:
            # The line does not show the firmware's time, so the host's time is the best available.
            self.carried = 0.0
            return speeds if fastest == 0.0 else None
        expected, self.covers_gap = elapsed + self.carried, False
        repeated = speeds == before and expected < REPEATED_FRACTION * self.period
        if repeated and self.misfit < MAX_MISFIT:
            self.carried = expected
            return AT_REST
        number, proved = _number(speeds, fastest, angle, expected)
        if gap:
            # If the command was lost, not its reply, the firmware went on counting.
            count = fastest / angle
            longer, sure = _number(speeds, fastest, angle, expected + gap)
            off = abs(longer - (expected + gap) * count)
            self.covers_gap = sure is True and (not proved or off < abs(number - expected * count))
            if self.covers_gap:
                number, proved, expected = longer, sure, expected + gap
        if proved is not None:
            # Only the other wheels can prove or refute whole counts.
            self.misfit += MISFIT_GAIN * ((not proved) - self.misfit)
        if self.misfit >= MAX_MISFIT:
            self.carried = 0.0
            return None
        count = fastest / angle
        if not number or (proved is None and jitter * count > MAX_COUNT_ERROR):
            self.carried, self.period = 0.0, expected
            return a * expected, b * expected, c * expected, d * expected
        self.period = number / count
        self.carried = CARRIED_ERROR * (expected - self.period)
        if abs(expected - self.period) <= self.period * ROUNDING / fastest:
            self.carried = 0.0  # the rounding of the speeds explains the difference
        count = self.period / angle
        return (
            round(a * count) * angle,
            round(b * count) * angle,
            round(c * count) * angle,
            round(d * count) * angle,
        )


def _number(
    speeds: Wheels4, fastest: float, angle: float, expected: float
) -> tuple[int, bool | None]:
    # The count of the fastest wheel (0 if unknown), and whether the speeds are counts: True and
    # False are certain.
    count = fastest / angle
    exact = expected * count  # counts if the host's time were right
    room = (MAX_TIME_ERROR * expected + MAX_TIME_ERROR_S) * count
    number = max(1, round(exact))
    if abs(number - exact) > room:
        return 0, False
    shares = {abs(speed) / fastest for speed in speeds} - {0.0, 1.0}
    if not shares:
        return number, None
    # With the share s of the fastest speed, s n is wrong by up to (1 + s) n rounding errors.
    error, chance, step = ROUNDING / fastest, 0.0, 1 if exact > number else -1
    for _ in range(MAX_TRIES):
        if number > 0:
            if abs(number - exact) > room:
                return 0, False
            by_chance, fits = 1.0, True
            for share in shares:
                whole, most = share * number, error * number * (1 + share)
                by_chance *= min(1.0, 2 * most)
                fits = fits and abs(whole - round(whole)) <= most
            chance += by_chance
            if chance > MAX_CHANCE:
                # If the firmware divides by a round period, the host's time alone agrees.
                return (number if fits and abs(number - exact) <= MAX_COUNT_ERROR else 0), None
            if fits:
                return number, True
        number += step
        step = -step - (1 if step > 0 else -1)
    return 0, None
