"""A part of a recording, given in seconds or by the time of day.

A recording may cross midnight, and its clock may be set in the middle of it. The time of day is
therefore looked up in every stretch between two clock steps.
"""

from __future__ import annotations

import math
import time
from itertools import pairwise
from typing import NamedTuple

from acsard.core.values import NS_PER_S, Instant
from acsard.recording.file import Recording
from acsard.recording.rows import BatchError, decode


class Span(NamedTuple):
    """A part of a recording, s after its beginning by the monotonic clock."""

    begin: float = -math.inf
    end: float = math.inf


WHOLE = Span()


def clock(seconds: float, day: bool = False) -> str:
    """Return a time in s since 1970 as local time, to the ms or with the date."""
    local = time.localtime(seconds)
    if day:
        return time.strftime("%Y-%m-%d %H:%M:%S", local)
    return time.strftime("%H:%M:%S", local) + f".{int(seconds % 1 * 1000):03}"


SET_NS = 5 * NS_PER_S
"""Difference between wall clock and monotonic clock that counts as a clock step, ns."""


class Stretch(NamedTuple):
    """A part of the recording in which the wall clock was not set."""

    at: float
    """Start of the stretch, s after the beginning of the recording."""
    begin: float
    end: float
    """End of the stretch, s since 1970, as is `begin`."""


def span(recording: Recording, begin: str | None, end: str | None) -> Span:
    """Return the part of a recording between two times, each in seconds or as HH:MM:SS."""
    found = stretches(recording) if any(":" in text for text in (begin, end) if text) else []
    return Span(
        -math.inf if begin is None else _seconds(begin, found),
        math.inf if end is None else _seconds(end, found),
    )


def _seconds(text: str, found: list[Stretch]) -> float:
    if ":" not in text:
        return float(text)
    hours, minutes, seconds = [*text.split(":"), "0"][:3]
    clock = int(hours), int(minutes), float(seconds)
    away, at = math.inf, 0.0
    for number, one in enumerate(found):
        least = one.at if number else -math.inf
        most = found[number + 1].at if number + 1 < len(found) else math.inf
        for day in (-1, 0, 1):
            moment = _on(one.begin, day, *clock)
            far = max(one.begin - moment, moment - one.end, 0.0)
            if far < away:
                away, at = far, min(max(one.at + moment - one.begin, least), most)
    return at


def _on(near: float, day: int, hours: int, minutes: int, seconds: float) -> float:
    """Return a time of day, s since 1970, `day` days after the date of `near`."""
    told = time.localtime(near)
    whole = (told.tm_year, told.tm_mon, told.tm_mday + day, hours, minutes, 0, 0, 0, -1)
    return time.mktime(whole) + seconds


def stretches(recording: Recording) -> list[Stretch]:
    """Return the stretches between clock steps, in order.

    There is one if the clock was never set.
    """
    found: list[Stretch] = []
    last_ns, before = 0, b""
    for topic, wall_ns, data in recording.messages():
        if topic != "steps":
            continue
        if found and 0 <= wall_ns - last_ns < SET_NS:
            found[-1] = found[-1]._replace(end=wall_ns / NS_PER_S)
        else:
            times = [*_instants(before), *_instants(data)]
            if not found and times:
                found.append(_from(recording, times[0]))
            for one, other in pairwise(times):
                ahead_ns = other.wall_ns - other.mono_ns - one.wall_ns + one.mono_ns
                if abs(ahead_ns) >= SET_NS:
                    found[-1] = found[-1]._replace(end=one.wall_ns / NS_PER_S)
                    found.append(_from(recording, other))
        last_ns, before = wall_ns, data
    return found


def _from(recording: Recording, now: Instant) -> Stretch:
    at = (now.mono_ns - recording.about.mono_ns) / NS_PER_S
    return Stretch(at, now.wall_ns / NS_PER_S, now.wall_ns / NS_PER_S)


def _instants(data: bytes) -> list[Instant]:
    """Return the time of each step in a message."""
    try:
        return [step.inputs.now for step in decode(data)]
    except BatchError:
        return []
