"""Describes the validity of the bus's TLS certificate, for `state`, `diagnostics` and `doctor`."""

from __future__ import annotations

from acsard.core.values import NS_PER_S

EXPIRY_DAYS = 30
"""Number of days of validity below which a certificate is a warning."""

DAY_NS = 86400 * NS_PER_S


def expiry(ends_ns: int | None, now_ns: int) -> tuple[int, str]:
    """Return the level (0 ok, 1 warning, 2 error) and a description of the certificate's validity.

    Args:
        ends_ns: the end of the certificate, wall-clock ns since 1970; None if it is unknown.
        now_ns: the present time, wall-clock ns since 1970.
    """
    if ends_ns is None:
        return (
            1,
            "unknown: the TLS gateway does not run, or the library that reads "
            "certificates is missing (`acsard doctor` says which)",
        )
    days = (ends_ns - now_ns) / DAY_NS
    if days < 0:
        return 2, f"expired {-days:.0f} days ago: TLS refuses every client"
    return int(days < EXPIRY_DAYS), f"valid for {days:.0f} days"
