"""Describes in words how long the TLS certificates stay valid."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from acsard.core.codes import Reason, reason
from acsard.core.values import NS_PER_S, WallNs

# Remaining days. Below the first, `state` and `diagnostics` warn; the log says each.
EXPIRY_DAYS = 30, 7, 1

DAY_NS = 86400 * NS_PER_S

# In `state`; behind `certificate_`, the code of the finding.
Expiry = Literal["valid", "expires", "expired", "unknown"]

DOCTOR = "run `acsard doctor` on the daemon's machine, where it examines the certificate files"


def expiry(
    ends: Mapping[str, WallNs], now_ns: WallNs, advice: str = DOCTOR, where: str = ""
) -> Reason:
    """Return the finding about the certificate that expires first.

    `ends` is by owner, "" for the robot's own, and empty if nothing is known.
    """
    if not ends:
        return reason("certificate_unknown", advice=advice)
    whose, ends_ns = first_expiry(ends)
    days = (ends_ns - now_ns) / DAY_NS
    of = f" (certificate of {whose})" if whose else ""
    values = {"span": _span(abs(days)), "of": of, "where": where, "advice": advice}
    if days < 0:
        values["of"] += _effect(ends, now_ns)
        return reason("certificate_expired", **values)
    near = days < EXPIRY_DAYS[0]
    return reason("certificate_expires" if near else "certificate_valid", **values)


def short_code(why: Reason) -> str:
    """Return the `Expiry` of a finding of `expiry`."""
    return why.code.removeprefix("certificate_")


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
