"""Fills gaps in the feedback: the motion of the wheels from one plausible line to the next.

Each wheel rolls by its encoder counts, by whole counts recovered from the speeds, or by speed times
time. A time for which no plausible line speaks is filled with the trapezoid of the speeds at its
ends, if it is shorter than `MAX_FILLED_GAP_S`. Otherwise its motion is unknown, and the pose stays.
No sound line is repaired: a speed that may be false is used, and doubted as much.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from msgspec import Struct

from acsard.core.link.coarse_encoders import MIN_COUNT_S
from acsard.core.link.feedback import MAX_FILLED_GAP_S, Line
from acsard.core.values import RadPerS, Seconds, Wheels4

# A line for more than this is judged like a gap, because a false speed in it is worth as much.
LONG_S = 0.03

# By which a sound speed leaves the range of the known ones: a share, by slopes and overshoot, and a
# count of an encoder with unknown counts.
ROUGHLY, ASSUMED_COUNT = 0.3, math.tau / 400

AT_REST: Wheels4 = (0.0, 0.0, 0.0, 0.0)


class Skipped(Struct):
    """The implausible lines since the last plausible one. Only their counts and times are used."""

    lines: int = 0
    lost: Seconds = 0.0  # without counts
    unknown: Seconds = 0.0
    counted: Seconds = 0.0
    turned: Wheels4 = AT_REST  # in `counted`, rad

    def add(self, line: Line) -> None:
        self.lines += 1
        if line.turned is None:
            self.lost += line.dt
            self.unknown += line.gap
        else:
            self.counted += line.dt
            self.turned = plus(self.turned, line.turned)


class End(NamedTuple):
    """One end of a gap: the speeds of its line that others confirm, and the rest of them.

    `alone` are the angles that one speed of one line says and nothing else: if it is false, that
    does not make the next one false.
    """

    speeds: Wheels4 = AT_REST  # rad/s
    alone: Wheels4 = AT_REST  # rad


class Rolled(Struct, frozen=True, gc=False):
    """The angles that the wheels rolled since the last plausible line, rad."""

    angles: Wheels4
    seconds: Seconds  # in which they rolled them
    filled: Seconds  # part of `seconds` for which no line speaks
    unknown: Seconds  # in addition to `seconds`
    vague: Seconds = 0.0  # part of `seconds` that the last line may not cover
    ends: tuple[End, End] = (End(), End())


def rolled_over(
    skipped: Skipped,
    line: Line,
    before: Wheels4,
    earlier: Wheels4,
    commanded: Wheels4,
    independent: int,
) -> Rolled:
    """Return the angles since the last plausible line.

    It had the speeds `before`, and the one before it the speeds `earlier`, rad/s. `independent` is
    the number of driven wheels.
    """
    speeds = line.speeds.as_tuple()
    if line.turned is not None:
        seconds, filled, unknown, angles = line.dt, 0.0, 0.0, line.turned
    else:
        seconds, filled, unknown = line.dt - line.bridged, line.bridged, line.gap
        angles = line.by_counts or times(speeds, seconds)
    if skipped.lines:
        angles = plus(skipped.turned, angles)
        seconds, filled = seconds + skipped.counted, filled + skipped.lost
        unknown += skipped.unknown
    if filled >= MAX_FILLED_GAP_S:
        filled, unknown = 0.0, unknown + filled
    if filled:
        angles = plus(angles, times(plus(before, speeds), filled / 2))
    ends = End(before), End(speeds)
    if line.turned is None:
        count = (line.count or ASSUMED_COUNT) / max(line.dt, MIN_COUNT_S)
        half = (filled + min(unknown, MAX_FILLED_GAP_S)) / 2
        partner, partner_before = before, earlier
        if independent == len(speeds):
            partner, partner_before = speeds[::-1], before[::-1]
        ends = (
            _end(before, (earlier, speeds, partner_before), count, half),
            _end(speeds, (before, commanded, partner), count, line.dt - line.bridged + half),
        )
    return Rolled(angles, seconds + filled, filled, unknown, line.vague, ends)


def _end(speeds: Wheels4, known: tuple[Wheels4, ...], count: RadPerS, seconds: Seconds) -> End:
    beyond = _beyond(speeds, known, count)
    return End(plus(speeds, times(beyond, -1.0)), times(beyond, seconds))


def _beyond(speeds: Wheels4, known: tuple[Wheels4, ...], count: RadPerS) -> Wheels4:
    # A wheel turns at a speed between its last one, its command, and that of the other wheel of its
    # side, roughly and but for a count.
    found = []
    for now, *others in zip(speeds, *known, strict=True):
        beyond = now - min(max(now, min(others)), max(others))
        usual = ROUGHLY * max(abs(now), *map(abs, others)) + count
        found.append(beyond if abs(beyond) > usual else 0.0)
    fr, fl, rl, rr = found
    return fr, fl, rl, rr


def plus(a: Wheels4, b: Wheels4) -> Wheels4:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]


def times(a: Wheels4, factor: float) -> Wheels4:
    return a[0] * factor, a[1] * factor, a[2] * factor, a[3] * factor
