"""Describes the validity of the bus's certificate, for `state`, `diagnostics` and `doctor`."""

from __future__ import annotations

from acsard.core.values import NS_PER_S

EXPIRY_DAYS = 30
"""Number of days before its end from which on a certificate is a warning."""

DAY_NS = 86400 * NS_PER_S


def expiry(ends_ns: int | None, now_ns: int) -> tuple[int, str]:
    """Return the level (0 ok, 1 warning, 2 error) and a description of the certificate's validity.

    Both times are wall-clock ns since 1970. `ends_ns` is None if the end is unknown.
    """
    if ends_ns is None:
        return 1, "unknown: no gateway, or no library to read it (`acsard doctor` says which)"
    days = (ends_ns - now_ns) / DAY_NS
    if days < 0:
        return 2, f"ended {-days:.0f} days ago: nobody can join any more"
    return int(days < EXPIRY_DAYS), f"valid for {days:.0f} days"
