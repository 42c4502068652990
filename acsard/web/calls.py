"""Services of the robot and questions to it: each in a thread of its own, so that a stop waits for
nothing, and so many at most."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, NamedTuple, TypeVar

from acsard.bus import fleet
from acsard.bus.access import MAY, SERVICE_ROLES
from acsard.bus.address import require_id
from acsard.client import Client
from acsard.host.errors import MendableError, UsageError
from acsard.host.threads import in_thread
from acsard.messages.encodings import DecodeError
from acsard.messages.schema import ServiceReply
from acsard.messages.topics import SERVICES
from acsard.values import AcsardError
from acsard.web.robots import Robots
from acsard.web.who import Who

AT_ONCE, STOPS_AT_ONCE = 16, 32
"""Of all viewers. Stops have a room of their own; more of them would all stop the same robot."""

ELSEWHERE_AT_ONCE = 8
"""Stops of other robots that are waited for; one beyond is told to its robot all the same."""

ANSWER_S = 8.0
"""Longer than a client waits for its answer, which says why there is none."""

BUSY = "busy: too many questions at once; ask again"

T = TypeVar("T")


class RefusedError(AcsardError):
    """Not for this role, or no such service; the text says which."""

    def __init__(self, text: str, role: bool) -> None:
        super().__init__(text)
        self.role = role
        """He may not; else there is none."""


class Ending(NamedTuple):
    """What became of what the page's server had begun beside the daemon."""

    words: str = ""
    """Empty where there was nothing."""
    ended: bool = True
    """Else it goes on for a while."""


async def _nothing() -> Ending:
    return Ending()


class Calls:
    """What is under way, at most so much."""

    def __init__(self, robots: Robots, ends: Callable[[], Awaitable[Ending]] = _nothing) -> None:
        """`ends` ends what the page's server has begun beside the daemon."""
        self._robots, self._ends = robots, ends
        self._running, self._stops, self._elsewhere = 0, Stops(), 0

    async def call(
        self, who: Who, verb: str, payload: Mapping[str, Any], robot: str = ""
    ) -> ServiceReply:
        """Call a service in the name of `who`, of another `robot` only stop; raises
        `RefusedError`."""
        require(who, verb)
        other = "" if robot == self._robots.id else robot
        if other:
            _require_stop(verb, other)
        if verb != "stop" or other:
            return await self._called(who, verb, payload, other)
        # A check has the port, and its wheels turn: the daemon, if there is one, cannot stop them.
        ending, reply = await asyncio.gather(self._ends(), self._called(who, verb, payload, other))
        if not ending.words:
            return reply
        return ServiceReply(reply.success and ending.ended, f"{ending.words}; {reply.message}")

    async def _called(
        self, who: Who, verb: str, payload: Mapping[str, Any], other: str
    ) -> ServiceReply:
        client = self._robots.client
        if client is None:
            return ServiceReply(False, self._robots.gone)

        def request() -> ServiceReply:
            return _named(client, other or self._robots.id, who).request(verb, payload)

        try:
            if other:
                reply = await self._stop(other, client, who, request)
            else:
                reply = await (self._stops.ask(request) if verb == "stop" else self._ask(request))
        except (MendableError, DecodeError, TimeoutError) as error:
            return ServiceReply(False, str(error) or "no answer in time")
        if verb == "set" and reply.success:
            self._robots.ask_anew()
        return reply

    async def get(self, robot: str, name: str) -> tuple[str, bytes]:
        """The last value of a key as JSON: encoding and payload; raises a `MendableError`."""
        client = self._robots.client
        if client is None:
            raise MendableError(self._robots.gone)
        return await self._ask(lambda: client.like(robot).reply(f"{name}?fmt=json"))

    async def _stop(
        self, robot: str, client: Client, who: Who, request: Callable[[], ServiceReply]
    ) -> ServiceReply:
        """Of another robot: names that none has keep none waiting."""
        if self._elsewhere < ELSEWHERE_AT_ONCE:
            self._elsewhere += 1
            try:
                return await in_thread(request, ANSWER_S)
            finally:
                self._elsewhere -= 1
        await in_thread(
            lambda: fleet.stop(client.session, [robot], _named(client, robot, who).caller), ANSWER_S
        )
        return ServiceReply(False, f"{robot} was told to stop; look at it: {BUSY}")

    async def _ask(self, call: Callable[[], T]) -> T:
        if self._running >= AT_ONCE:
            raise MendableError(BUSY)
        self._running += 1
        try:
            return await in_thread(call, ANSWER_S)
        finally:
            self._running -= 1


class Stops:
    """So many at once; those beyond wait, together, for one that is asked after all of them."""

    def __init__(self) -> None:
        self._room = asyncio.Semaphore(STOPS_AT_ONCE)
        self._next: asyncio.Task[ServiceReply] | None = None

    async def ask(self, call: Callable[[], ServiceReply]) -> ServiceReply:
        """The robot's own answer, of this call or of one that is asked later than now."""
        if not self._room.locked():
            async with self._room:
                return await in_thread(call, ANSWER_S)
        if self._next is None:
            self._next = asyncio.create_task(self._later(call))
            self._next.add_done_callback(lambda done: done.cancelled() or done.exception())
        return await asyncio.shield(self._next)

    async def _later(self, call: Callable[[], ServiceReply]) -> ServiceReply:
        async with self._room:
            self._next = None  # who comes from now on is confirmed by another
            return await in_thread(call, ANSWER_S)


def require(who: Who, verb: str) -> None:
    """Raises `RefusedError`."""
    if verb not in SERVICES:
        raise RefusedError(f"no service {verb!r}; there are {', '.join(SERVICES)}", role=False)
    least = SERVICE_ROLES[verb]
    if not who.may(least):
        raise RefusedError(
            f"{verb} is for who is at least {least}; you are {who.role}: {MAY[who.role]}", role=True
        )


def _require_stop(verb: str, robot: str) -> None:
    """Raises `RefusedError`."""
    try:
        require_id(robot)
    except UsageError as error:
        raise RefusedError(str(error), role=False) from None
    if verb != "stop":
        raise RefusedError(
            f"{robot} is not this page's robot: here it is seen and stopped; for {verb} open its "
            "own page",
            role=True,
        )


def _named(client: Client, robot: str, who: Who) -> Client:
    """The daemon's log says who called."""
    other = client.like(robot)
    other.name = _caller(who)
    return other


def _caller(who: Who) -> str:
    return f"{who.name}@page"
