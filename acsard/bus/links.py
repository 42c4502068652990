"""Whether what `bus.connect` names is connected: a thread of its own asks Zenoh, which may block.

Zenoh connects again by itself and says nothing of it; nobody would know that a router is missing.
"""

from __future__ import annotations

import socket
from threading import Event, Thread

import zenoh

from acsard.bus.inbox import Inbox
from acsard.config.settings import BusConfig
from acsard.values import RoutersStatus

EVERY_S = 0.5
"""How often to ask: it takes Zenoh 0.1 ms."""

STOP_S = 0.05


class Links:
    """Looks after the links of one session."""

    def __init__(self, bus: BusConfig, inbox: Inbox) -> None:
        """The inbox is told which routers there are."""
        self._bus, self._inbox = bus, inbox
        self._status: RoutersStatus | None = None
        self._news = False
        """Set behind the status, so that none is overlooked."""
        self._over = Event()
        self._thread = Thread(target=self._run, name="links", daemon=True)
        self._session: zenoh.Session

    def news(self) -> RoutersStatus | None:
        """What is connected, if that is another than at the last call; never waits."""
        if not self._news:
            return None
        self._news = False
        return self._status

    def start(self, session: zenoh.Session) -> None:
        """Begin to ask: also where we connect to nothing, a router may have connected to us."""
        self._session = session
        self._thread.start()

    def stop(self) -> None:
        """Ask no more; whoever looks up a name is not waited for."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(STOP_S)

    def _run(self) -> None:
        connects = False  # first it has time to
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
        except zenoh.ZError:  # it is being closed
            return self._status or RoutersStatus()
        routers = (zid for zid, kind in kinds.items() if kind == zenoh.WhatAmI.ROUTER)
        self._inbox.routers = frozenset(routers)
        missing = unreached(self._bus.mode, endpoints, set(far))
        connected = tuple(one for one in endpoints if one not in missing)
        ends = {end for end, zid in far.items() if kinds.get(zid) == zenoh.WhatAmI.PEER}
        peers = tuple(one for one in connected if _leads_there(one, ends))
        return RoutersStatus(connected, missing, peers)


def unreached(mode: str, endpoints: tuple[str, ...], ends: set[str]) -> tuple[str, ...]:
    """Which endpoints no link leads to, by the far `ends` of the links.

    A client has one link only: with that none is missing. Who has dialled us (the door, a bridge, a
    ROS node) has a port of its own there. Names are looked up, which may block.
    """
    if mode == "client":
        return () if ends else endpoints
    return tuple(one for one in endpoints if not _leads_there(one, ends))


def _leads_there(endpoint: str, ends: set[str]) -> bool:
    """Zenoh has addresses of its links where the configuration may have names."""
    bare = endpoint.partition("?")[0].partition("#")[0]
    protocol, _, place = bare.partition("/")
    host, _, port = place.rpartition(":")
    if bare in ends:
        return True
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)
    except (OSError, ValueError):  # its name is lost, which does not end a link
        return bool(port) and any(
            end.startswith(f"{protocol}/") and end.endswith(f":{port}") for end in ends
        )
    hosts = (str(one[4][0]) for one in found)
    return any(f"{protocol}/{f'[{one}]' if ':' in one else one}:{port}" in ends for one in hosts)
