"""Connections as such: so many at most, and none that says nothing for ever.

A WebSocket or request is refused by the application; this is for who never gets so far.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from acsard.web.counts import Counts
from acsard.web.limits import Places
from acsard.web.who import unmapped

SOCKETS, SOCKETS_OF_ONE = 256, 64
"""TCP connections: a browser opens six beside its WebSocket."""

REQUEST_S = 10.0
"""Whoever has not sent the whole head of a request by then is sent away."""

Factory = Callable[[], asyncio.Protocol]


class Gate:
    """Counts who is connected."""

    def __init__(self, counts: Counts) -> None:
        self.counts = counts
        self._doors: dict[asyncio.BaseTransport, _Door] = {}

    def guarded(self, inner: Factory) -> Factory:
        """The same protocols, behind this gate: with places of their own for each address of ours,
        so that strangers never shut out who is at the machine."""
        places = Places(SOCKETS, SOCKETS_OF_ONE)
        return lambda: _Door(self, places, inner)

    def spoke(self, transport: asyncio.BaseTransport | None) -> None:
        """A request has come on it."""
        if transport is not None and (door := self._doors.get(transport)) is not None:
            door.hurry(False)

    def opened(self, transport: asyncio.BaseTransport, door: _Door) -> None:
        self._doors[transport] = door

    def closed(self, transport: asyncio.BaseTransport) -> None:
        self._doors.pop(transport, None)


class _Door(asyncio.Protocol):
    """One connection: the inner protocol sees it only when there is room."""

    def __init__(self, gate: Gate, places: Places, inner: Factory) -> None:
        self._gate, self._places, self._make = gate, places, inner
        self._inner: asyncio.Protocol | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._peer = ""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        peer = transport.get_extra_info("peername")
        self._peer = unmapped(str(peer[0])) if peer else ""
        self._transport = transport
        if not self._places.enter(self._peer):
            self._gate.counts.refuse("crowded", self._peer)
            transport.abort()  # type: ignore[attr-defined]
            return
        self._inner = self._make()
        self._gate.opened(transport, self)
        self.hurry(True)
        self._inner.connection_made(transport)

    def hurry(self, on: bool) -> None:
        """It has to say something soon, or may take its time."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None
        if on:
            self._timer = asyncio.get_running_loop().call_later(REQUEST_S, self._give_up)

    def _give_up(self) -> None:
        self._gate.counts.refuse("slow", self._peer)
        self._transport.abort()  # type: ignore[attr-defined]

    def data_received(self, data: bytes) -> None:
        if self._inner is not None:
            self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        return None if self._inner is None else self._inner.eof_received()

    def pause_writing(self) -> None:
        if self._inner is not None:
            self._inner.pause_writing()

    def resume_writing(self) -> None:
        if self._inner is not None:
            self._inner.resume_writing()

    def connection_lost(self, error: Exception | None) -> None:
        self.hurry(False)
        if self._inner is None:
            return
        self._places.leave(self._peer)
        self._gate.closed(self._transport)
        self._inner.connection_lost(error)
