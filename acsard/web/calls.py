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
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.keys_and_roles import SERVICE_NAME, service_key
from acsard.core.messages.permissions import least_role
from acsard.core.messages.refusals import BUSY
from acsard.core.messages.schema import ServiceReply
from acsard.host.errors import MendableError, UsageError
from acsard.host.rate_limits import Places
from acsard.host.threads import in_thread
from acsard.machine.kept_settings import set_and_keep
from acsard.web.callers import AdmittedClient, RequestRefusedError
from acsard.web.followed_robot import FollowedRobot
from acsard.web.tasks import shared

# At the same time: queries and calls other than a stop, and stops.
MAX_CALLS, MAX_STOPS = 16, 32

# between two stops that are sent for one client
MIN_STOP_INTERVAL_S = 0.02

# `Client` has a shorter limit, and raises an error with a clear message.
ANSWER_TIMEOUT_S = 8.0

T = TypeVar("T")

Stop = Callable[[], Awaitable[ServiceReply]]


class Calls:
    """Sends service calls and queries to the robot, within the limits of this module."""

    def __init__(self, robot: FollowedRobot, config: str | None = None) -> None:
        self._robot, self._config = robot, config
        self._stops, self._merged = Stops(), StopMerger()
        self._asks = Places(MAX_CALLS, MAX_CALLS)

    async def call(
        self, identity: AdmittedClient, verb: str, payload: Mapping[str, Any]
    ) -> ServiceReply:
        """Call a service for a client.

        Raises `RequestRefusedError` if the client may not do that.
        """
        require(identity, verb)
        client = self._robot.client
        if client is None:
            return ServiceReply(False, self._robot.gone)

        def request() -> ServiceReply:
            named = _named(client, identity)
            if verb != "set" or "keep" not in payload:
                return named.request(verb, payload)
            arguments = dict(payload)
            keep, settings = arguments.pop("keep"), arguments.get("settings")
            if keep is True and isinstance(settings, dict):
                return set_and_keep(named, self._config, settings)
            return named.request(verb, arguments)

        async def stop() -> ServiceReply:
            return await self._stops.send_stop(request)

        try:
            if verb == "stop":
                reply = await self._merged.send_stop(identity.token, stop)
            else:
                reply = await self._run_call(request)
        except (MendableError, UsageError, DecodeError, TimeoutError) as error:
            return ServiceReply(False, str(error) or "the robot did not answer in time: try again")
        if verb == "set" and reply.success:
            self._robot.refresh_about()
        return reply

    async def get(self, name: str) -> tuple[str, bytes]:
        """Query the last value of a key as JSON: (encoding, payload).

        Raises `MendableError` without bus or answer or if too many calls run, and `TimeoutError` if
        the bus is stuck.
        """
        client = self._robot.client
        if client is None:
            raise MendableError(self._robot.gone)
        return await self._run_call(lambda: client.reply(f"{name}?fmt=json"))

    async def _run_call(self, call: Callable[[], T]) -> T:
        with self._asks.place() as free:
            if not free:
                raise MendableError(BUSY)
            return await in_thread(call, ANSWER_TIMEOUT_S)


class StopMerger:
    """Merges the stops of one client in quick succession.

    The first is sent at once. All within `MIN_STOP_INTERVAL_S` after a sent one share the next, so
    none is lost.
    """

    def __init__(self) -> None:
        # Set and removed `MIN_STOP_INTERVAL_S` after a client's last stop.
        self._rests: dict[str, asyncio.Event] = {}
        # waits for that event, then sends a stop
        self._next: dict[str, asyncio.Task[ServiceReply]] = {}

    async def send_stop(self, name: str, stop: Stop) -> ServiceReply:
        """Send a stop, or share the one of the client that waits; return the reply."""
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
    """Limits the stops at the same time.

    All further callers share one, sent when an earlier one has ended.
    """

    def __init__(self) -> None:
        self._room = asyncio.Semaphore(MAX_STOPS)
        self._next: asyncio.Task[ServiceReply] | None = None

    async def send_stop(self, call: Callable[[], ServiceReply]) -> ServiceReply:
        """Send a stop by `call`, or wait for the shared one, and return the reply."""
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
    """Raise `RequestRefusedError` if the client may not call the service.

    The daemon refuses a service that it does not have. One that is unknown here is for maintainers.
    """
    if not SERVICE_NAME.fullmatch(verb):
        raise RequestRefusedError("malformed", f"{verb!r} is not the name of a service")
    caller.require(least_role(service_key(verb)), verb)


def _named(client: Client, identity: AdmittedClient) -> Client:
    # The robot's daemon logs the calls of this client under its name.
    other = client.sibling(client.where.robot_id)
    other.name = f"{identity.name}@page"
    return other
