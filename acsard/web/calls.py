"""Sends the service calls and queries of the page's clients to the robot.

Each call blocks a thread of its own. Calls of the service `stop` ("stops") have their own limits,
so a stop never waits for other calls. If clients request several stops in quick succession, the
server sends the first stop immediately. Later requests may share one stop, which the server sends
after the last of these requests has arrived.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, TypeVar

from acsard.client import Client
from acsard.core.incoming.queries import BUSY
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.keys_and_roles import SERVICES
from acsard.core.messages.permissions import SERVICE_ROLES
from acsard.core.messages.schema import ServiceReply
from acsard.host.errors import MendableError
from acsard.host.rate_limits import Places
from acsard.host.threads import in_thread
from acsard.web.callers import AdmittedClient, RequestRefusedError
from acsard.web.robots import Robots
from acsard.web.tasks import shared

MAX_CALLS, MAX_STOPS = 16, 32
"""`MAX_CALLS` is the maximum number of simultaneous queries and service calls; stops do not count.
`MAX_STOPS` is the maximum number of simultaneous stops of the page's own robot."""

MIN_STOP_INTERVAL_S = 0.02
"""Shortest interval between two stops that the server sends for one client, s."""

ANSWER_TIMEOUT_S = 8.0
"""Time limit for an answer over the bus, s. `Client` has a shorter limit, and raises an error with
a clear message."""

T = TypeVar("T")

Stop = Callable[[], Awaitable[ServiceReply]]


class Calls:
    """Sends service calls and queries to the robot, within the limits of this module."""

    def __init__(self, robots: Robots) -> None:
        self._robots = robots
        self._stops, self._merged = Stops(), StopMerger()
        self._asks = Places(MAX_CALLS, MAX_CALLS)

    async def call(
        self, identity: AdmittedClient, verb: str, payload: Mapping[str, Any]
    ) -> ServiceReply:
        """Call the service `verb` for the client `identity`, and return the reply.

        Raises `RequestRefusedError` if the client may not make this call.
        """
        require(identity, verb)
        client = self._robots.client
        if client is None:
            return ServiceReply(False, self._robots.gone)

        def request() -> ServiceReply:
            return _named(client, identity).request(verb, payload)

        async def stop() -> ServiceReply:
            return await self._stops.send_stop(request)

        try:
            if verb == "stop":
                reply = await self._merged.send_stop(identity.token, stop)
            else:
                reply = await self._run_call(request)
        except (MendableError, DecodeError, TimeoutError) as error:
            return ServiceReply(False, str(error) or "the robot did not answer in time: try again")
        if verb == "set" and reply.success:
            self._robots.refresh_about()
        return reply

    async def get(self, name: str) -> tuple[str, bytes]:
        """Query the last value of a key as JSON, and return the pair (encoding, payload).

        Raises `MendableError` if there is no connection to the bus, if no answer arrives, or if
        `MAX_CALLS` calls and queries are running already. Raises `TimeoutError` if the bus is stuck
        for `ANSWER_TIMEOUT_S`.
        """
        client = self._robots.client
        if client is None:
            raise MendableError(self._robots.gone)
        return await self._run_call(lambda: client.reply(f"{name}?fmt=json"))

    async def _run_call(self, call: Callable[[], T]) -> T:
        with self._asks.place() as free:
            if not free:
                raise MendableError(BUSY)
            return await in_thread(call, ANSWER_TIMEOUT_S)


class StopMerger:
    """Merges the stops that one client requests in quick succession.

    The server sends the first stop immediately. All stops that the client requests within
    `MIN_STOP_INTERVAL_S` after a sent stop share the next stop. So none of them is lost.
    """

    def __init__(self) -> None:
        self._rests: dict[str, asyncio.Event] = {}
        """Maps a client to an event. `MIN_STOP_INTERVAL_S` after the last sent stop, the
        event is removed from this dict and set."""
        self._next: dict[str, asyncio.Task[ServiceReply]] = {}
        """Maps a client to the task that waits for the event in `_rests` and then sends a
        stop."""

    async def send_stop(self, name: str, stop: Stop) -> ServiceReply:
        """Send a stop by calling `stop`, and return the reply.

        If another stop with the same `name` still waits to be sent, return the reply to that stop
        instead. `name` identifies the client.
        """
        if name in self._next:
            return await asyncio.shield(self._next[name])
        rest = self._rests.get(name)
        if rest is None:
            self._begin_pause(name)
            return await stop()
        self._next[name] = shared(self._later(name, rest, stop))
        return await asyncio.shield(self._next[name])

    def _begin_pause(self, name: str) -> None:
        self._rests[name] = asyncio.Event()
        asyncio.get_running_loop().call_later(
            MIN_STOP_INTERVAL_S, lambda: self._rests.pop(name).set()
        )

    async def _later(self, name: str, rest: asyncio.Event, stop: Stop) -> ServiceReply:
        # If the event loop is late, `rest` may be set and gone from `_rests` before this starts.
        await rest.wait()
        del self._next[name]  # later callers share the next stop
        self._begin_pause(name)
        return await stop()


class Stops:
    """Limits the stops of the page's own robot to `MAX_STOPS` at the same time.

    All callers beyond this limit share one stop, which is sent when an earlier stop has ended.
    """

    def __init__(self) -> None:
        self._room = asyncio.Semaphore(MAX_STOPS)
        self._next: asyncio.Task[ServiceReply] | None = None

    async def send_stop(self, call: Callable[[], ServiceReply]) -> ServiceReply:
        """Send a stop by calling `call`, and return the reply.

        If `MAX_STOPS` stops are running, wait for the next stop, and return the reply to it.
        All callers that wait get this reply.
        """
        if not self._room.locked():
            async with self._room:
                return await in_thread(call, ANSWER_TIMEOUT_S)
        if self._next is None:
            self._next = shared(self._later(call))
        return await asyncio.shield(self._next)

    async def _later(self, call: Callable[[], ServiceReply]) -> ServiceReply:
        async with self._room:
            self._next = None  # later callers share the next request
            return await in_thread(call, ANSWER_TIMEOUT_S)


def require(caller: AdmittedClient, verb: str) -> None:
    """Raise `RequestRefusedError` if the service does not exist, or the client may not call it."""
    if verb not in SERVICES:
        raise RequestRefusedError(
            "malformed", f"{verb!r} is not a service; choose one of {', '.join(SERVICES)}"
        )
    caller.require(SERVICE_ROLES[verb], verb)


def _named(client: Client, identity: AdmittedClient) -> Client:
    # The robot's daemon logs the calls of this client under its name.
    other = client.sibling(client.where.robot_id)
    other.name = f"{identity.name}@page"
    return other
