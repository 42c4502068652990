"""Converts the typed times of `--from` and `--to` to a range of the wall clock."""

from __future__ import annotations

import re
from datetime import datetime, time, timedelta

from acsard.core.values import NS_PER_S, AcsardError, WallNs

TIME_EXAMPLES = '14:05, "yesterday 14:05", "2026-11-21 14:05:30", today, 2026-11-21, 2h (ago)'

AFTER_EXAMPLE = "+5m (after --from)"

_DAYS_AGO = {"today": 0, "yesterday": 1}

_UNITS = {"s": "seconds", "m": "minutes", "min": "minutes", "h": "hours", "d": "days"}

_DURATION = re.compile(r"(\+?)(\d{1,9}(?:\.\d+)?) ?(s|min|m|h|d)(?: ago)?")

_DAY = timedelta(days=1)


class TimeError(AcsardError):
    """A typed time has the wrong form, or a range ends before it begins."""


def time_range(
    begin: str | None, end: str | None, now: datetime
) -> tuple[WallNs | None, WallNs | None]:
    """Return the range in local time; None is no limit. Raises `TimeError`.

    A time of day is the last one before the present; as the end, the first one after `begin`.
    """
    first = None if begin is None else _span(begin, now, None)[0]
    last = None if end is None else _span(end, now, first)[1]
    if first is not None and last is not None and last <= first:
        raise TimeError(f"--to is {last:%Y-%m-%d %H:%M:%S}, not after --from: correct one of them")
    return _wall_ns(first), _wall_ns(last)


def _wall_ns(at: datetime | None) -> WallNs | None:
    return None if at is None else round(at.timestamp() * NS_PER_S)


def _span(text: str, now: datetime, after: datetime | None) -> tuple[datetime, datetime]:
    # The begin and the end of what the text names: they differ for a whole day.
    try:
        if found := _DURATION.fullmatch(text):
            sign, count, unit = found.groups()
            duration = timedelta(**{_UNITS[unit]: float(count)})
            if sign and after is None:
                raise TimeError(f"{text} counts from --from, which is missing")
            at = after + duration if sign and after else now - duration
            return at, at
        word, _, rest = text.partition(" ")
        if word in _DAYS_AGO:
            day = now.date() - _DAYS_AGO[word] * _DAY
            text = f"{day} {rest}".strip()
        if re.match(r"\d{4}-", text):
            at = datetime.fromisoformat(text)
            return at, at + (_DAY if len(text) == len("2026-11-21") else timedelta())
        at = datetime.combine((after or now).date(), time.fromisoformat(text))
    except (ValueError, OverflowError):
        raise TimeError(f"{text} is not a time; write for example {TIME_EXAMPLES}") from None
    if after is None and at > now:
        at -= _DAY
    elif after is not None and at < after:
        at += _DAY
    return at, at
