"""Watches whether the daemon's session is connected to the endpoints of `bus.connect`."""

from __future__ import annotations

import socket
from threading import Event

import zenoh

from acsard.bus.tls_files import host_and_port
from acsard.core.config.settings import BusConfig
from acsard.core.values import RoutersStatus
from acsard.host.mailbox import Mailbox
from acsard.host.threads import Worker

POLL_S = 0.5  # one poll takes Zenoh 0.1 ms

STOP_TIMEOUT_S = 0.05  # for the polling thread


class RouterLinks:
    """Observes the daemon's connections to the endpoints of `bus.connect`.

    Zenoh reconnects by itself without a report, and a call may block, so a thread polls.
    """

    def __init__(self, bus: BusConfig, errors: list[BaseException]) -> None:
        # `errors` gets an exception that ends the thread.
        self._bus = bus
        self._status: RoutersStatus | None = None
        self.changes = Mailbox[RoutersStatus](1, lambda: None)  # newest state, if it has changed
        self._over = Event()
        self._thread = Worker("links", self._run, errors.append)
        self._session: zenoh.Session

    def start(self, session: zenoh.Session) -> None:
        """Start the polling thread, unless `bus.connect` is empty."""
        self._session = session
        if self._bus.connect:
            self._thread.start()

    def stop(self) -> None:
        """Stop polling, in at most `STOP_TIMEOUT_S`: a name lookup may block the thread."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(STOP_TIMEOUT_S)

    def _run(self) -> None:
        # The first wait gives Zenoh the time to connect.
        while not self._over.wait(POLL_S):
            status = self._poll()
            if status != self._status:
                self._status = status
                self.changes.put(status)

    def _poll(self) -> RoutersStatus:
        endpoints = self._bus.connect
        try:
            info = self._session.info
            zids = {str(link.dst): str(link.zid) for link in info.links()}
            kinds = {str(transport.zid): transport.whatami for transport in info.transports()}
        except zenoh.ZError:
            # The session is closing.
            return self._status or RoutersStatus()
        missing = unreached(self._bus.mode, endpoints, set(zids))
        connected = tuple(endpoint for endpoint in endpoints if endpoint not in missing)
        peer_ends = {end for end, zid in zids.items() if kinds.get(zid) == zenoh.WhatAmI.PEER}
        peers = tuple(endpoint for endpoint in connected if _leads_there(endpoint, peer_ends))
        return RoutersStatus(connected, missing, peers)


def unreached(mode: str, endpoints: tuple[str, ...], ends: set[str]) -> tuple[str, ...]:
    """Return the endpoints without a link; this may block in a name lookup.

    In mode "client" the only link is to one of them. `ends` are far ends such as
    "tcp/192.168.0.2:7447"; a program that connects to the daemon has a random port, which matches
    none.
    """
    if mode == "client":
        return () if ends else endpoints
    return tuple(endpoint for endpoint in endpoints if not _leads_there(endpoint, ends))


def _leads_there(endpoint: str, ends: set[str]) -> bool:
    # May block in a name lookup.
    if endpoint in ends:
        return True
    protocol, (host, port) = endpoint.partition("/")[0], host_and_port(endpoint)
    try:
        entries = socket.getaddrinfo(host, int(port), type=socket.SOCK_STREAM)
    except (OSError, ValueError):
        # The name no longer resolves, but a link to that host may still exist. So compare only the
        # protocol and the port.
        return bool(port) and any(
            end.startswith(f"{protocol}/") and end.endswith(f":{port}") for end in ends
        )
    ips = (str(entry[4][0]) for entry in entries)
    return any(f"{protocol}/{f'[{ip}]' if ':' in ip else ip}:{port}" in ends for ip in ips)
