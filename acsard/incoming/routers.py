"""Reports changes in the connections of `bus.connect` to the log and the counters."""

from __future__ import annotations

from collections.abc import MutableMapping

from acsard.values import Event, RoutersStatus

PEER = (
    "is no router but another peer, a robot's daemon perhaps: neither hands on what the other "
    "says, so who connects to one sees that one only, and `acsard call stop --id '*'` stops no "
    "other; put a router between them (deploy/zenoh/README.md)"
)


class RoutersTold:
    """Follower of the endpoints that this daemon should be connected to."""

    def __init__(self) -> None:
        self.status = RoutersStatus()

    def hear(
        self, status: RoutersStatus, counters: MutableMapping[str, int], events: list[Event]
    ) -> None:
        """Take the present status. Log and count each connection that was lost or made."""
        before, self.status = self.status, status
        gone = [one for one in status.missing if one not in before.missing]
        come = [one for one in status.connected if one not in before.connected]
        if gone:
            counters["router_missing"] = counters.get("router_missing", 0) + len(gone)
            events.append(Event("router_missing", _words("not connected to", gone), "warning"))
        if come:
            events.append(Event("router_found", _words("connected to", come)))
        peers = [one for one in status.peers if one not in before.peers]
        if peers:
            events.append(Event("no_router", f"{', '.join(peers)} {PEER}", "warning"))


def _words(what: str, endpoints: list[str]) -> str:
    tried = "; tried again until it answers, driving goes on" if what.startswith("not") else ""
    return f"{what} {', '.join(endpoints)}{tried}"
