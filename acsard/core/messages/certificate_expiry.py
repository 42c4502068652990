"""Describes how long the TLS certificates are valid, for `state`, `diagnostics` and `doctor`."""

from __future__ import annotations

from collections.abc import Mapping

from acsard.core.values import NS_PER_S

EXPIRY_DAYS = 30
"""If a certificate expires in fewer days than this, its expiry is a warning."""

DAY_NS = 86400 * NS_PER_S


def expiry(ends: Mapping[str, int], now_ns: int) -> tuple[int, str]:
    """Return the level (0 ok, 1 warning, 2 error) and a description of the validity.

    Only the description of level 0 begins with "valid". `ends` is the expiry time of each
    certificate that TLS needs, by the name of its owner. The robot's own certificate has the name
    "". The mapping is empty if no expiry time is known. Times are wall-clock ns since 1970.
    """
    if not ends:
        return (
            1,
            "unknown: the TLS gateway does not run, or the library that reads "
            "certificates is missing (`acsard doctor` says which)",
        )
    whose, ends_ns = first(ends)
    of = f" (certificate of {whose})" if whose else ""
    days = (ends_ns - now_ns) / DAY_NS
    if days < 0:
        return 2, f"expired {-days:.0f} days ago{of}: TLS refuses every client"
    if days < EXPIRY_DAYS:
        return 1, f"ends in {days:.0f} days{of}"
    return 0, f"valid for {days:.0f} days{of}"


def first(ends: Mapping[str, int]) -> tuple[str, int]:
    """Return the owner and the expiry time of the certificate that expires first.

    The TLS gateway reports the earliest expiry time of all certificates under the name "". If a
    certificate with an owner's name has the same time, that name is returned.
    """
    return min(ends.items(), key=lambda one: (one[1], one[0] == ""))
