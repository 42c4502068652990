"""Watches whether the endpoints of `bus.connect` are connected.

Zenoh reconnects by itself and does not report it, so nobody would notice a missing router. A thread
of its own polls Zenoh, because the call may block.
"""

from __future__ import annotations

import socket
from threading import Event, Thread

import zenoh

from acsard.bus.inbox import Inbox
from acsard.config.settings import BusConfig
from acsard.values import RoutersStatus

EVERY_S = 0.5
"""Seconds between two polls. One poll takes Zenoh 0.1 ms."""

STOP_S = 0.05


class Links:
    """Watcher of the links of one session."""

    def __init__(self, bus: BusConfig, inbox: Inbox) -> None:
        """Prepare the watcher. It writes the ids of connected routers to `inbox.routers`."""
        self._bus, self._inbox = bus, inbox
        self._status: RoutersStatus | None = None
        self._news = False
        """Whether the status has changed. It is set after the status, so that no change is
        overlooked."""
        self._over = Event()
        self._thread = Thread(target=self._run, name="links", daemon=True)
        self._session: zenoh.Session

    def news(self) -> RoutersStatus | None:
        """Return the status if it has changed since the last call, else None. Never wait."""
        if not self._news:
            return None
        self._news = False
        return self._status

    def start(self, session: zenoh.Session) -> None:
        """Start polling.

        Poll even without `bus.connect`, because a router may have connected to the daemon.
        """
        self._session = session
        self._thread.start()

    def stop(self) -> None:
        """Stop polling. Do not wait for a name lookup that is under way."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(STOP_S)

    def _run(self) -> None:
        connects = False  # the first poll reports nothing: Zenoh has had no time to connect yet
        while True:
            status = self._look()
            if connects and status != self._status:
                self._status, self._news = status, True
            connects = bool(self._bus.connect)
            if self._over.wait(EVERY_S):
                return

    def _look(self) -> RoutersStatus:
        endpoints = self._bus.connect
        try:
            info = self._session.info
            far = {str(link.dst): str(link.zid) for link in info.links()}
            kinds = {str(one.zid): one.whatami for one in info.transports()}
        except zenoh.ZError:  # the session is closing
            return self._status or RoutersStatus()
        routers = (zid for zid, kind in kinds.items() if kind == zenoh.WhatAmI.ROUTER)
        self._inbox.routers = frozenset(routers)
        missing = unreached(self._bus.mode, endpoints, set(far))
        connected = tuple(one for one in endpoints if one not in missing)
        ends = {end for end, zid in far.items() if kinds.get(zid) == zenoh.WhatAmI.PEER}
        peers = tuple(one for one in connected if _leads_there(one, ends))
        return RoutersStatus(connected, missing, peers)


def unreached(mode: str, endpoints: tuple[str, ...], ends: set[str]) -> tuple[str, ...]:
    """Return the endpoints that no link leads to, given the far `ends` of all links.

    A client has one link only, so with any link it misses none. A program that connected to the
    daemon (the TLS gateway, a bridge, a ROS node) has an ephemeral port at its end and matches no
    endpoint. Host names are resolved, which may block.
    """
    if mode == "client":
        return () if ends else endpoints
    return tuple(one for one in endpoints if not _leads_there(one, ends))


def _leads_there(endpoint: str, ends: set[str]) -> bool:
    """Return whether a link leads to the endpoint.

    Zenoh lists addresses; the endpoint may be a name.
    """
    bare = endpoint.partition("?")[0].partition("#")[0]
    protocol, _, place = bare.partition("/")
    host, _, port = place.rpartition(":")
    if bare in ends:
        return True
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)
    except (OSError, ValueError):  # the name no longer resolves, which does not end a link
        return bool(port) and any(
            end.startswith(f"{protocol}/") and end.endswith(f":{port}") for end in ends
        )
    hosts = (str(one[4][0]) for one in found)
    return any(f"{protocol}/{f'[{one}]' if ':' in one else one}:{port}" in ends for one in hosts)
