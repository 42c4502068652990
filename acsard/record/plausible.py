"""What no daemon has recorded: numbers that come from somebody who made a file by hand."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from acsard.record.layout import Rare, Spread

LONGEST_NS = 1 << 61
"""Since a computer was switched on, and the age of a read: 73 years."""

LATEST_NS = 1 << 62
"""From the monotonic clock to the wall clock: the year 2116. All three together have 64 bits."""


def implausible(spread: Spread) -> str:
    """Why these are no steps of a robot's, "" when they may be."""
    bounds = ((spread.times, LONGEST_NS), (spread.ages, LONGEST_NS), (spread.offsets, LATEST_NS))
    if any(max(map(abs, times), default=0) >= most for times, most in bounds):
        return "a time that no clock shows"
    if not all(map(math.isfinite, _numbers(spread.rare.values()))):
        return "a pose or a gyro that is no number"
    return ""


def _numbers(rare: Iterable[Rare]) -> Iterator[float]:
    """Those that are looked at before they become inputs; commands are, once more, by the robot."""
    for one in rare:
        for request in one.requests:
            if request.pose is not None:
                yield from (request.pose.x, request.pose.y, request.pose.yaw)
        for sample in one.gyro:
            yield from (sample.rate, sample.variance)
