"""Formats texts and values for people to read.

Before untrusted text is written to a terminal, it must go through `printable`, `lines` or
`json_line`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate

_DAYS_TO_1970 = 719_468
"""Days from 0000-03-01 to 1970-01-01. `utc` counts years from March, so that the leap day is the
last day of a year."""

_DAYS_PER_400_YEARS = 146_097


def printable(text: str) -> str:
    """Return the text as one line without control characters, which is safe to print.

    White space becomes " ". Other unprintable characters become U+FFFD.
    """
    return "".join(" " if c.isspace() else c if c.isprintable() else "\ufffd" for c in text)


def lines(text: str) -> str:
    """Return a text of several lines with `printable` applied to each line."""
    return "\n".join(map(printable, text.split("\n")))


def printable_bytes(data: bytes, most: int, last: bool = False) -> str:
    r"""Return bytes as a text of at most `most` characters, with "…" for the bytes left out.

    If the text is too long, it shows the first bytes, or the last bytes if `last` is true. The "…"
    is an additional character. An unprintable byte is written as an escape such as `\x00`.
    """
    texts = [repr(bytes([byte]))[2:-1] for byte in (reversed(data) if last else data)]
    ends = accumulate(map(len, texts))
    selection = [text for text, end in zip(texts, ends, strict=True) if end <= most]
    cut = "…" if len(selection) < len(texts) else ""
    return cut + "".join(reversed(selection)) if last else "".join(selection) + cut


_ABOVE_ASCII = re.compile(r"[^\x00-\x7e]")


def json_line(text: str) -> str:
    """Escape the unprintable characters of a JSON text without changing the encoded value."""
    return _ABOVE_ASCII.sub(
        # JSON writes a character above U+FFFF as two escapes.
        lambda m: m[0] if m[0].isprintable() else json.dumps(m[0])[1:-1],
        text,
    )


def many(count: int, singular: str, more: str = "") -> str:
    """Return a count with its noun, such as `no lines`, `1 line` or `2 changes of mode`.

    `singular` is the noun in the singular, such as `line` or `change of mode`. `more` is the
    plural. Leave it out if the plural only adds an "s".
    """
    noun, of, rest = singular.partition(" of ")
    return f"{count or 'no'} {singular if count == 1 else more or f'{noun}s{of}{rest}'}"


def listed(items: Sequence[str], most: int, joint: str = ", ") -> str:
    """Join the first `most` items with `joint`. If there are more items, append "and N more"."""
    more = [f"and {len(items) - most} more"] if len(items) > most else []
    return joint.join([*items[:most], *more])


def signed(value: float | None, decimals: int, width: int) -> str:
    """Format a number with its sign, right-aligned in `width` characters.

    `decimals` is the number of decimals. None and NaN become "-". A number that is too long for
    `width` is written with one digit and an exponent.
    """
    if value is None or math.isnan(value):
        return "-".rjust(width)
    text = f"{round(value, decimals) + 0.0:+.{decimals}f}"  # + 0.0 turns "-0.00" into "+0.00"
    return (
        text if len(text) <= width else f"{value:+.0e}".replace("e+0", "e").replace("e+", "e")
    ).rjust(width)


_UNITS = (("d", 86_400), ("h", 3_600), ("min", 60), ("s", 1))


def lasting(seconds: float) -> str:
    """Format a duration in s with its two largest units, such as "2 h 5 min".

    A duration below 1 min is written with one decimal, such as "7.3 s".
    """
    if seconds < 59.95:
        return f"{round(seconds, 1):g} s"
    parts: list[tuple[int, str]] = []
    rest = round(seconds)
    for unit, size in _UNITS:
        count, rest = divmod(rest, size)
        if count or parts:
            parts.append((count, unit))
    return " ".join(f"{count} {unit}" for count, unit in parts[:2] if count)


_ROUGH = (
    ("µs", 1e-6, 999.5e-6), ("ms", 1e-3, 0.9995), ("s", 1.0, 99.5), ("min", 60.0, 99.5 * 60),
    ("h", 3600.0, 99.5 * 3600), ("d", 86400.0, math.inf),
)  # fmt: skip
"""Units for `rough`. Each row contains a unit, its size in s, and the duration in s at which the
next row begins."""


def rough(seconds: float | None, finest: float = 1.0) -> str:
    """Format a duration in s with one unit, such as "2.5 min", in at most 7 characters.

    `finest` is the size of the smallest unit to use, s. None and infinity become "never". NaN,
    negative values and values of 1e9 s or more become "?".
    """
    if seconds is None or seconds == math.inf:
        return "never"
    if not 0.0 <= seconds < 1e9:
        return "?"
    unit, size = next((u, s) for u, s, most in _ROUGH if s >= finest and seconds < most)
    value = seconds / size
    return f"{value:.{int(value < 9.95)}f} {unit}"


# The daemon publishes the times of up to 36 causes of latches in every step, so they are cached.
@lru_cache(64)
def utc(wall_ns: int) -> str:
    """Return a time, ns since 1970, in the form `2026-11-22 13:05:07 UTC` (Gregorian calendar)."""
    days, seconds = divmod(wall_ns // 1_000_000_000, 86_400)
    era, day = divmod(days + _DAYS_TO_1970, _DAYS_PER_400_YEARS)
    year = (day - day // 1_460 + day // 36_524 - day // 146_096) // 365
    day -= 365 * year + year // 4 - year // 100
    month = (5 * day + 2) // 153
    day -= (153 * month + 2) // 5
    month = month + 3 if month < 10 else month - 9
    year += 400 * era + (month <= 2)
    hour, minute = seconds // 3_600, seconds // 60 % 60
    return f"{year:04}-{month:02}-{day + 1:02} {hour:02}:{minute:02}:{seconds % 60:02} UTC"
