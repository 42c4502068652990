"""Refuses a decoded batch with values that no daemon records, because somebody forged the file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from acsard.record.layout import Rare, Spread

LONGEST_NS = 1 << 61
"""Bound of the time since the computer's start and of the age of a read: 73 years."""

LATEST_NS = 1 << 62
"""Bound of the offset between the monotonic and the wall clock, which the wall clock reaches in
the year 2116. The sum of all three fits in 64 bits.
"""


def implausible(spread: Spread) -> str:
    """Return why these steps cannot come from a robot, or "" if they can."""
    bounds = ((spread.times, LONGEST_NS), (spread.ages, LONGEST_NS), (spread.offsets, LATEST_NS))
    if any(max(map(abs, times), default=0) >= most for times, most in bounds):
        return "a time that no clock shows"
    if not all(map(math.isfinite, _numbers(spread.rare.values()))):
        return "a pose or a gyro that is no number"
    return ""


def _numbers(rare: Iterable[Rare]) -> Iterator[float]:
    """Yield the numbers that must be finite. The robot itself checks those of commands."""
    for one in rare:
        for request in one.requests:
            if request.pose is not None:
                yield from (request.pose.x, request.pose.y, request.pose.yaw)
        for sample in one.gyro:
            yield from (sample.rate, sample.variance)
