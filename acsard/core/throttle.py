"""Limits how often something happens: at a rate on average, and in bursts.

It is the generic cell rate algorithm: a name may be used while the uses so far are at most a burst
ahead of the rate. The module reads no clock: the caller passes the time.
"""

from __future__ import annotations

from typing import NamedTuple

from msgspec import Struct

from acsard.core.values import NS_PER_S, Ns


class Rate(NamedTuple):
    """A permitted rate: `hz` uses per second on average, in bursts of up to `burst` uses."""

    hz: float
    burst: float = 1.0


class Throttle(Struct):
    """Limits the rate of each name."""

    free_ns: dict[str, Ns] = {}  # when the whole burst of a name is free again; past if missing

    def take(self, now_ns: Ns, rate: Rate, name: str = "") -> bool:
        """Use `name` once; return False if its rate is used up."""
        period_ns = round(NS_PER_S / rate.hz)
        free_ns = max(self.free_ns.get(name, now_ns), now_ns)
        if free_ns > now_ns + round((rate.burst - 1.0) * period_ns):
            return False
        if name not in self.free_ns:  # many names must not fill the memory
            self.free_ns = {other: at_ns for other, at_ns in self.free_ns.items() if at_ns > now_ns}
        self.free_ns[name] = free_ns + period_ns
        return True
