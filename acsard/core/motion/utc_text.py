"""Wall-clock time in words, computed from nanoseconds alone: the core reads no clock."""

from __future__ import annotations

from functools import lru_cache

from acsard.core.values import NS_PER_S

_DAYS_TO_1970 = 719_468
"""Days from 0000-03-01 to 1970-01-01; years that begin in March end with the leap day."""

_DAYS_PER_400_YEARS = 146_097


# A latched robot says in each step when it was latched.
@lru_cache(8)
def utc(wall_ns: int) -> str:
    """Return a time given in ns since 1970 as `2026-11-22 13:05:07 UTC` (Gregorian calendar)."""
    days, seconds = divmod(wall_ns // NS_PER_S, 86_400)
    era, day = divmod(days + _DAYS_TO_1970, _DAYS_PER_400_YEARS)
    year = (day - day // 1_460 + day // 36_524 - day // 146_096) // 365
    day -= 365 * year + year // 4 - year // 100
    month = (5 * day + 2) // 153
    day -= (153 * month + 2) // 5
    month = month + 3 if month < 10 else month - 9
    year += 400 * era + (month <= 2)
    hour, minute = seconds // 3_600, seconds // 60 % 60
    return f"{year:04}-{month:02}-{day + 1:02} {hour:02}:{minute:02}:{seconds % 60:02} UTC"
