"""Sends the service calls, stops and queries of the page's clients to the robot.

Each call blocks a thread of its own, so a stop never waits for other calls. Of each caller, one
stop is under way, and one more follows it, which all later presses share. So each press is answered
by a stop that was sent after it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

from acsard.client.connection import Connection
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.keys_and_roles import SERVICE_NAME, service_key
from acsard.core.messages.permissions import least_role
from acsard.core.messages.schema import ServiceReply
from acsard.host.errors import MendableError, NoAnswerError, UsageError
from acsard.host.threads import in_thread
from acsard.web.callers import AdmittedClient, RequestRefusedError
from acsard.web.followed_robot import FollowedRobot

# `Client` has a shorter limit, and raises an error with a clear message.
ANSWER_TIMEOUT_S = 8.0


class Calls:
    """The calls of all clients of the page, over one connection to the robot."""

    def __init__(self, robot: FollowedRobot) -> None:
        self._robot = robot
        self._stops: dict[str, _Stops] = {}

    async def call(
        self, identity: AdmittedClient, verb: str, payload: Mapping[str, Any]
    ) -> ServiceReply:
        """Call a service for a client.

        Raises `RequestRefusedError` if the client may not do that.
        """
        require(identity, verb)
        if self._robot.client is None:
            return ServiceReply(False, unanswered(verb))
        # The robot's daemon logs the call under this name.
        client = self._robot.client.named(f"{identity.name}@page")
        try:
            if verb == "stop":
                return await self._stops.setdefault(client.name, _Stops()).send(client)
            reply = await in_thread(lambda: client.request(verb, payload), ANSWER_TIMEOUT_S)
        except (NoAnswerError, TimeoutError):
            return ServiceReply(False, unanswered(verb))
        except (MendableError, UsageError, DecodeError) as error:
            return ServiceReply(False, str(error))
        if verb == "set" and reply.success:
            self._robot.refresh_about()
        return reply

    async def get(self, name: str) -> tuple[str, bytes]:
        """Query the last value of a key as JSON: (encoding, payload).

        Raises `MendableError` without bus or answer, and `TimeoutError` if the bus is stuck.
        """
        client = self._robot.client
        if client is None:
            raise MendableError(self._robot.gone)
        return await in_thread(lambda: client.reply(f"{name}?fmt=json"), ANSWER_TIMEOUT_S)


class _Stops:
    def __init__(self) -> None:
        self._under_way = asyncio.Lock()
        self._next: asyncio.Task[ServiceReply] | None = None

    async def send(self, client: Connection) -> ServiceReply:
        if self._next is None:
            self._next = asyncio.create_task(self._send(client))
            # Its error counts as retrieved even if all callers have gone.
            self._next.add_done_callback(lambda done: done.cancelled() or done.exception())
        return await asyncio.shield(self._next)

    async def _send(self, client: Connection) -> ServiceReply:
        async with self._under_way:
            self._next = None  # a later press needs a later stop
            return await in_thread(lambda: client.request("stop", {}), ANSWER_TIMEOUT_S)


def unanswered(verb: str) -> str:
    """Return the sentence for a call that the robot did not answer."""
    return f"the robot's daemon does not answer, so `{verb}` is not confirmed: does it run?"


def require(caller: AdmittedClient, verb: str) -> None:
    """Raise `RequestRefusedError` if the client may not call the service.

    The daemon refuses a service that it does not have. One that is unknown here is for maintainers.
    """
    if not SERVICE_NAME.fullmatch(verb):
        raise RequestRefusedError("malformed", f"{verb!r} is not the name of a service")
    caller.require(least_role(service_key(verb)), verb)
