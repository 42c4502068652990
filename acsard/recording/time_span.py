"""Parses times that a person types, and finds the part of a recording between two such times.

A recording may cross midnight, and the wall clock may be adjusted in it, so a time is searched in
each `Stretch` between adjustments.
"""

from __future__ import annotations

import math
import re
import time
from itertools import pairwise
from typing import NamedTuple

from acsard.core.values import NS_PER_S, AcsardError, Instant
from acsard.recording.mcap_file import Recording
from acsard.recording.recorded_steps import RecordedStep
from acsard.recording.rows import BatchError, decode
from acsard.recording.timeline import MIN_CLOCK_CHANGE_NS, clock_change_ns


class Span(NamedTuple):
    """A part of a recording, between two monotonic times in s after its beginning."""

    begin: float = -math.inf
    end: float = math.inf


WHOLE_SPAN = Span()


class Offset(NamedTuple):
    """A typed number of seconds after the beginning of a recording."""

    seconds: float


class TimeOfDay(NamedTuple):
    """A typed local time of day without a date."""

    hours: int
    minutes: int
    seconds: float


MIDNIGHT = TimeOfDay(0, 0, 0.0)


class Moment(NamedTuple):
    """A time with a date, as "2 h ago", or as a whole day, whose `begin` and `end` differ."""

    begin: float  # s since 1970
    end: float  # s since 1970


When = Offset | TimeOfDay | Moment  # as typed

# For messages, without the form of `Offset`.
TIME_EXAMPLES = (
    '14:05, 14:05:30, today, "yesterday 14:05", "2026-11-21 14:05", 2026-11-21 or "2 h ago"'
)

ALL_EXAMPLES = f"{TIME_EXAMPLES}; for one recording also a number of seconds after its beginning"

_CLOCK = re.compile(r"(\d\d):(\d\d)(?::(\d\d(?:\.\d+)?))?")
_AGO = re.compile(r"(\d+(?:\.\d+)?) ?(s|min|h|d)\w* ago")
_UNIT_S = {"s": 1, "min": 60, "h": 3600, "d": 86400}
_DAYS_AGO = {"today": 0, "yesterday": 1}


class TimeError(AcsardError):
    """A text that a person typed is not a valid time or range of time."""


def parse_when(text: str, now_s: float) -> When:
    """Parse a typed time (`ALL_EXAMPLES`). Raises `TimeError` with advice."""
    words = re.sub(r"(?<=\d)t(?=\d)", " ", " ".join(text.lower().split()))
    if re.fullmatch(r"\d+(\.\d+)?", words):
        return Offset(float(words))
    if ago := _AGO.fullmatch(words):
        # No recording is older than 1970, and not every system can convert older times to a date.
        moment = max(0.0, now_s - float(ago[1]) * _UNIT_S[ago[2]])
        return Moment(moment, moment)
    day, _, rest = words.partition(" ")
    if ":" in day:
        return _time_of_day(words, text)
    date = _date(day, text, now_s)
    if not rest:
        return Moment(_moment(date), _moment(date, days=1))
    at = _moment(date, _time_of_day(rest, text))
    return Moment(at, at)


def _time_of_day(words: str, text: str) -> TimeOfDay:
    match = _CLOCK.fullmatch(words)
    if match is None:
        raise _unknown(text)
    clock = TimeOfDay(int(match[1]), int(match[2]), float(match[3] or 0))
    if clock.hours > 23 or clock.minutes > 59 or clock.seconds >= 60:
        raise TimeError(
            f"{words} is not a time of day: a day goes from 00:00 to 23:59:59; write for example "
            f"{ALL_EXAMPLES}"
        )
    return clock


def _date(words: str, text: str, now_s: float) -> tuple[int, int, int]:
    # Year, month, day; "yesterday" on the first of a month is the day 0.
    if words in _DAYS_AGO:
        today = time.localtime(now_s)
        return today.tm_year, today.tm_mon, today.tm_mday - _DAYS_AGO[words]
    if not re.fullmatch(r"(19|20)\d\d-\d\d-\d\d", words):
        raise _unknown(text)
    try:
        date = time.strptime(words, "%Y-%m-%d")
    except ValueError:
        raise TimeError(
            f"{words} is not a date: the calendar has no such day; correct it"
        ) from None
    return date.tm_year, date.tm_mon, date.tm_mday


def _moment(date: tuple[int, int, int], when: TimeOfDay = MIDNIGHT, days: int = 0) -> float:
    # s since 1970; the day 0 is the last one of the month before
    year, month, day = date
    whole = (year, month, day + days, when.hours, when.minutes, 0, 0, 0, -1)
    return time.mktime(whole) + when.seconds


def _unknown(text: str) -> TimeError:
    return TimeError(f"{text} is not a time; write for example {ALL_EXAMPLES}")


def resolve(begin: When | None, end: When | None, now_s: float) -> tuple[float, float]:
    """Return a typed range as (first, last), s since 1970, without a limit for None and `Offset`.

    A `TimeOfDay` as the end is the first one after `begin`, and otherwise the most recent one
    before the present, and before `end` if that has a date. Raises `TimeError` if the range ends
    before it begins.
    """
    first, last = -math.inf, math.inf
    if isinstance(begin, TimeOfDay):
        before_s = now_s
        if isinstance(end, Moment):
            # A whole day ends at a midnight that belongs to the next day.
            before_s = min(now_s, math.nextafter(end.end, 0.0) if end.end > end.begin else end.end)
        first = _last_occurrence(begin, before_s)
    elif isinstance(begin, Moment):
        first = begin.begin
    if isinstance(end, Moment):
        last = end.end
    elif isinstance(end, TimeOfDay):
        last = _last_occurrence(end, now_s)
        if math.isfinite(first):
            last = next(at for day in range(3) if (at := _on(first, day, end)) >= first)
    if last < first:
        raise TimeError(
            f"--from is {clock(first, day=True)}, which is after --to, {clock(last, day=True)}: "
            "correct one of them"
        )
    return first, last


def _last_occurrence(when: TimeOfDay, before_s: float) -> float:
    return next(at for day in range(3) if (at := _on(before_s, -day, when)) <= before_s)


def clock(seconds: float, day: bool = False) -> str:
    """Return s since 1970 as local time: "14:05:30.250", or "2026-11-21 14:05:30" with the day."""
    local = time.localtime(seconds)
    if day:
        return time.strftime("%Y-%m-%d %H:%M:%S", local)
    return time.strftime("%H:%M:%S", local) + f".{int(seconds % 1 * 1000):03}"


def date(seconds: float) -> str:
    """Return the local date of s since 1970, such as "2026-11-21"."""
    return time.strftime("%Y-%m-%d", time.localtime(seconds))


class Stretch(NamedTuple):
    """A part of a recording without an adjustment of the wall clock."""

    at: float  # s after the beginning of the recording
    begin: float  # s since 1970
    end: float  # s since 1970


def span(recording: Recording, begin: When | None, end: When | None) -> Span:
    """Return the part of a recording between two typed times; None is no limit."""
    by_clock = any(isinstance(when, TimeOfDay | Moment) for when in (begin, end))
    contents = read_contents(recording) if by_clock else None
    stretch_list = contents.stretches if contents else []
    return Span(
        -math.inf if begin is None else _seconds(begin, stretch_list, end=False),
        math.inf if end is None else _seconds(end, stretch_list, end=True),
    )


def _seconds(when: When, stretch_list: list[Stretch], end: bool) -> float:
    if isinstance(when, Offset):
        return when.seconds
    away, at = math.inf, 0.0
    for number, stretch in enumerate(stretch_list):
        least = stretch.at if number else -math.inf
        most = stretch_list[number + 1].at if number + 1 < len(stretch_list) else math.inf
        if isinstance(when, Moment):
            moments = [when.end if end else when.begin]
        else:
            moments = [_on(stretch.begin, day, when) for day in (-1, 0, 1)]
        for moment in moments:
            far = max(stretch.begin - moment, moment - stretch.end, 0.0)
            if far < away:
                away, at = far, min(max(stretch.at + moment - stretch.begin, least), most)
    return at


def part_between(stretch_list: list[Stretch], first: float, last: float) -> Span | None:
    """Return the part between two times, s since 1970, with all stretches that overlap, or None."""
    inside = [stretch for stretch in stretch_list if stretch.begin <= last and first <= stretch.end]
    if not inside:
        return None
    begin = min(stretch.at + max(first, stretch.begin) - stretch.begin for stretch in inside)
    end = max(stretch.at + min(last, stretch.end) - stretch.begin for stretch in inside)
    # A part that includes the last step must also include the end of the file.
    whole_begin = inside[0] is stretch_list[0] and first <= stretch_list[0].begin
    whole_end = inside[-1] is stretch_list[-1] and last >= stretch_list[-1].end
    return Span(-math.inf if whole_begin else begin, math.inf if whole_end else end)


def _on(near: float, day: int, when: TimeOfDay) -> float:
    date = time.localtime(near)
    return _moment((date.tm_year, date.tm_mon, date.tm_mday), when, day)


class Contents(NamedTuple):
    """The stretches of a recording, and its first and last readable step."""

    stretches: list[Stretch]
    first: RecordedStep
    last: RecordedStep


def read_contents(recording: Recording) -> Contents | None:
    """Return the contents of a recording, or None if no step is readable."""
    stretch_list: list[Stretch] = []
    first: RecordedStep | None = None
    last_ns, before = 0, b""
    for topic, wall_ns, data in recording.messages():
        if topic != "steps":
            continue
        if first is not None and 0 <= wall_ns - last_ns < MIN_CLOCK_CHANGE_NS:
            stretch_list[-1] = stretch_list[-1]._replace(end=wall_ns / NS_PER_S)
        else:
            batch = _steps(data)
            times = [step.inputs.now for step in (*_steps(before), *batch)]
            if first is None and batch:
                first = batch[0]
                stretch_list.append(_from(recording, first.inputs.now))
            for previous, other in pairwise(times):
                if abs(clock_change_ns(previous, other)) >= MIN_CLOCK_CHANGE_NS:
                    stretch_list[-1] = stretch_list[-1]._replace(end=previous.wall_ns / NS_PER_S)
                    stretch_list.append(_from(recording, other))
        last_ns, before = wall_ns, data
    if first is None:
        return None
    last = first
    if batch := _steps(before):
        last = batch[-1]
        stretch_list[-1] = stretch_list[-1]._replace(end=last.inputs.now.wall_ns / NS_PER_S)
    return Contents(stretch_list, first, last)


def _from(recording: Recording, now: Instant) -> Stretch:
    at = (now.mono_ns - recording.about.mono_ns) / NS_PER_S
    return Stretch(at, now.wall_ns / NS_PER_S, now.wall_ns / NS_PER_S)


def _steps(data: bytes) -> list[RecordedStep]:
    try:
        return decode(data) if data else []
    except BatchError:
        return []
