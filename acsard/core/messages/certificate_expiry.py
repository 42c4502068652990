"""Says how long the TLS certificates stay valid, for `state`, `diagnostics` and `acsard doctor`."""

from __future__ import annotations

from collections.abc import Mapping

from acsard.core.values import NS_PER_S

EXPIRY_DAYS = 30
"""`state` and `diagnostics` show a warning if a certificate expires in fewer days than this."""

DAY_NS = 86400 * NS_PER_S


def expiry(ends: Mapping[str, int], now_ns: int) -> tuple[int, str]:
    """Return a pair: the level (0 ok, 1 warning, 2 error) and a text about the validity.

    The text begins with "valid" only at level 0. `ends` maps the owner of each certificate that TLS
    needs to the time at which it expires. The owner of the robot's own certificate is "". The
    mapping is empty if no expiry time is known. All times are wall-clock ns since 1970.
    """
    if not ends:
        return (
            1,
            "unknown, because the TLS gateway does not run, or the library that reads "
            "certificates is missing (`acsard doctor` says which)",
        )
    whose, ends_ns = first(ends)
    of = f" (certificate of {whose})" if whose else ""
    days = (ends_ns - now_ns) / DAY_NS
    if days < 0:
        return 2, f"expired {-days:.0f} days ago{of}: TLS refuses every client"
    if days < EXPIRY_DAYS:
        return 1, f"expires in {days:.0f} days{of}"
    return 0, f"valid for {days:.0f} days{of}"


def first(ends: Mapping[str, int]) -> tuple[str, int]:
    """Return a pair for the certificate that expires first: its owner, and when it expires.

    `ends` maps owners to expiry times, wall-clock ns since 1970. The time of the owner "" may come
    from the TLS gateway, which reports only the earliest time of all certificates. So if another
    owner has the same time, the certificate is the other owner's, and the result names that owner.
    """
    return min(ends.items(), key=lambda one: (one[1], one[0] == ""))
