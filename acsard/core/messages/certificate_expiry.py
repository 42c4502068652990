"""Describes in words how long the TLS certificates stay valid.

The messages `state` and `diagnostics` and the command `acsard doctor` show these words.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from acsard.core.values import NS_PER_S

EXPIRY_DAYS = 30
"""Remaining validity of a certificate, days, below which `state` and `diagnostics` show a
warning."""

DAY_NS = 86400 * NS_PER_S


CertificateCode = Literal["valid", "expires", "expired", "unknown"]

CERTIFICATE_LEVELS: dict[str, int] = {"valid": 0, "expires": 1, "expired": 2, "unknown": 1}
"""Diagnostic level of each code: 0 ok, 1 warning, 2 error."""


def expiry(ends: Mapping[str, int], now_ns: int) -> tuple[CertificateCode, str]:
    """Return a pair: a code, and a text about the certificate that expires first.

    Args:
        ends: the time at which each certificate that TLS needs expires, wall-clock ns since 1970,
            by the owner of the certificate. The owner of the robot's own certificate is "". The
            mapping is empty if no expiry time is known.
        now_ns: the present wall-clock time, ns since 1970.
    """
    if not ends:
        return (
            "unknown",
            "unknown: the TLS gateway is not running, or the library that reads certificates is "
            "missing (`acsard doctor` says which)",
        )
    whose, ends_ns = first_expiry(ends)
    of = f" (certificate of {whose})" if whose else ""
    days = (ends_ns - now_ns) / DAY_NS
    if days < 0:
        return "expired", f"expired {-days:.0f} days ago{of}{_effect(ends, now_ns)}"
    if days < EXPIRY_DAYS:
        return "expires", f"expires in {days:.0f} days{of}"
    return "valid", f"valid for {days:.0f} days{of}"


def _effect(ends: Mapping[str, int], now_ns: int) -> str:
    # Zenoh ignores the dates of an authority, so TLS refuses clients only if the robot's own
    # certificate has expired.
    own_ns, others = ends.get("", now_ns), [ends_ns for owner, ends_ns in ends.items() if owner]
    if own_ns >= now_ns or own_ns in others:
        return ""
    if not others:
        # The time may come from the gateway, which does not say whose certificate it is.
        return ": if it is the certificate of the robot, TLS refuses every client"
    return ": TLS refuses every client"


def first_expiry(ends: Mapping[str, int]) -> tuple[str, int]:
    """Return the certificate that expires first, as a pair: its owner and its expiry time.

    `ends` maps owners to expiry times, wall-clock ns since 1970. The owner "" stands for the
    robot's own certificate, or for the report of the TLS gateway, which does not name the owner. If
    a certificate with a named owner expires at the same time, the report is about that certificate.
    Therefore the result then names this owner.
    """
    return min(ends.items(), key=lambda pair: (pair[1], pair[0] == ""))
