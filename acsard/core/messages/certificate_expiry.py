"""Describes in words how long the TLS certificates stay valid."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from acsard.core.values import NS_PER_S, WallNs

# Remaining days. Below the first, `state` and `diagnostics` warn; the log says each.
EXPIRY_DAYS = 30, 7, 1

DAY_NS = 86400 * NS_PER_S


CertificateCode = Literal["valid", "expires", "expired", "unknown"]

# 0 ok, 1 warning, 2 error.
CERTIFICATE_LEVELS: dict[str, int] = {"valid": 0, "expires": 1, "expired": 2, "unknown": 1}


def expiry(ends: Mapping[str, WallNs], now_ns: WallNs) -> tuple[CertificateCode, str]:
    """Return a code and a text about the certificate that expires first.

    `ends` is by owner, "" for the robot's own, and empty if nothing is known.
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
        return "expired", f"expired {_span(-days)} ago{of}{_effect(ends, now_ns)}"
    if days < EXPIRY_DAYS[0]:
        return "expires", f"expires in {_span(days)}{of}"
    return "valid", f"valid for {days:.0f} days{of}"


def urgency(ends: Mapping[str, WallNs], now_ns: WallNs) -> int:
    """Return how many of `EXPIRY_DAYS` the first expiry is below."""
    days = (first_expiry(ends)[1] - now_ns) / DAY_NS
    return sum(days < bound for bound in EXPIRY_DAYS)


def _span(days: float) -> str:
    return f"{days:.0f} days" if days >= 2.0 else f"{24.0 * days:.0f} hours"


def _effect(ends: Mapping[str, WallNs], now_ns: WallNs) -> str:
    # Zenoh ignores the dates of an authority, so TLS refuses clients only if the robot's own
    # certificate has expired.
    own_ns, others = ends.get("", now_ns), [ends_ns for owner, ends_ns in ends.items() if owner]
    if own_ns >= now_ns or own_ns in others:
        return ""
    if not others:
        # The time may come from the gateway, which does not say whose certificate it is.
        return ": if it is the certificate of the robot, TLS refuses every client"
    return ": TLS refuses every client"


def first_expiry(ends: Mapping[str, WallNs]) -> tuple[str, WallNs]:
    """Return the owner and the time of the certificate that expires first.

    "" is the robot's own or the TLS gateway's report. An owner with the same time is the one that
    it is about, so it is named.
    """
    return min(ends.items(), key=lambda pair: (pair[1], pair[0] == ""))
