"""Formats texts and values for people to read.

Untrusted text goes to a terminal only through `printable`, `lines` or `json_line`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate

from acsard.core.values import WallNs

_DAYS_TO_1970 = 719_468  # from 0000-03-01: in years from March, the leap day is the last one

_DAYS_PER_400_YEARS = 146_097


def printable(text: str) -> str:
    """Return the text as one line that is safe to print; unprintable characters are U+FFFD."""
    return "".join(" " if c.isspace() else c if c.isprintable() else "\ufffd" for c in text)


def lines(text: str) -> str:
    """Return a text of several lines, each `printable`."""
    return "\n".join(map(printable, text.split("\n")))


def printable_bytes(data: bytes, most: int, last: bool = False) -> str:
    r"""Return bytes as text of at most `most` characters, with "…" for those left out.

    It has the first bytes, or the `last` ones. Unprintable bytes are escapes such as `\x00`.
    """
    texts = [repr(bytes([byte]))[2:-1] for byte in (reversed(data) if last else data)]
    ends = accumulate(map(len, texts))
    selection = [text for text, end in zip(texts, ends, strict=True) if end <= most]
    cut = "…" if len(selection) < len(texts) else ""
    return cut + "".join(reversed(selection)) if last else "".join(selection) + cut


_ABOVE_ASCII = re.compile(r"[^\x00-\x7e]")


def json_line(text: str) -> str:
    """Escape the unprintable characters of a JSON text, of which the value stays."""
    return _ABOVE_ASCII.sub(
        # JSON writes a character above U+FFFF as two escapes.
        lambda m: m[0] if m[0].isprintable() else json.dumps(m[0])[1:-1],
        text,
    )


def after_mode(mode: str, reason: str) -> str:
    """Return "mode: reason", without the mode if the reason begins with it ("stopped by ...")."""
    return reason if reason.startswith(mode) else f"{mode}: {reason}"


def many(count: int, singular: str, more: str = "") -> str:
    """Return a count with its noun, such as `no lines`, `1 line` or `2 changes of mode`.

    `more` is a plural without a mere "s".
    """
    noun, of, rest = singular.partition(" of ")
    return f"{count or 'no'} {singular if count == 1 else more or f'{noun}s{of}{rest}'}"


def listed(items: Sequence[str], most: int, joint: str = ", ") -> str:
    """Join the first `most` items, with "and N more" if there are more."""
    more = [f"and {len(items) - most} more"] if len(items) > most else []
    return joint.join([*items[:most], *more])


def signed(value: float | None, decimals: int, width: int) -> str:
    """Format a number with its sign, right-aligned; None and NaN are "-".

    One that is too long has one digit and an exponent.
    """
    if value is None or math.isnan(value):
        return "-".rjust(width)
    text = f"{round(value, decimals) + 0.0:+.{decimals}f}"  # + 0.0 turns "-0.00" into "+0.00"
    return (
        text if len(text) <= width else f"{value:+.0e}".replace("e+0", "e").replace("e+", "e")
    ).rjust(width)


_UNITS = (("d", 86_400), ("h", 3_600), ("min", 60), ("s", 1))


def lasting(seconds: float) -> str:
    """Format s with the two largest units, such as "2 h 5 min", or "7.3 s" below 1 min."""
    if seconds < 59.95:
        return f"{round(seconds, 1):g} s"
    parts: list[tuple[int, str]] = []
    rest = round(seconds)
    for unit, size in _UNITS:
        count, rest = divmod(rest, size)
        if count or parts:
            parts.append((count, unit))
    return " ".join(f"{count} {unit}" for count, unit in parts[:2] if count)


# Unit, its size in s, and the duration in s of the next row.
_ROUGH = (
    ("µs", 1e-6, 999.5e-6), ("ms", 1e-3, 0.9995), ("s", 1.0, 99.5), ("min", 60.0, 99.5 * 60),
    ("h", 3600.0, 99.5 * 3600), ("d", 86400.0, math.inf),
)  # fmt: skip


def rough(seconds: float | None, finest: float = 1.0) -> str:
    """Format s with one unit, not below `finest`, such as "2.5 min", in 7 characters.

    None and inf are "never"; NaN, negative values and 1e9 s are "?".
    """
    if seconds is None or seconds == math.inf:
        return "never"
    if not 0.0 <= seconds < 1e9:
        return "?"
    unit, size = next((u, s) for u, s, most in _ROUGH if s >= finest and seconds < most)
    value = seconds / size
    return f"{value:.{int(value < 9.95)}f} {unit}"


# The daemon publishes the times of up to 32 causes of latches in every step, so they are cached.
@lru_cache(64)
def utc(wall_ns: WallNs) -> str:
    """Return a time in the form `2026-11-22 13:05:07 UTC` (Gregorian calendar)."""
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
