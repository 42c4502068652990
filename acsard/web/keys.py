"""The keys that one viewer subscribes to: robot, rate and lifetime."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

from acsard.daemon.bus.address import require_id
from acsard.host.errors import UsageError
from acsard.web.frames import Subscribe, Unsubscribe
from acsard.web.limits import STREAMS, STREAMS_OF_ONE, Shares
from acsard.web.robots import AGAIN_S, Robots
from acsard.web.socket_sender import Following, Outgoing
from acsard.web.streams import KEYS, UNREADY, Stream

MOST = 32

FRAMES_HZ = 300.0
"""Maximum message rate of all keys of one connection together. The limit keeps viewers from taking
the processor time that driving needs."""

CLIENT_S = 0.2
"""Interval at which a subscription checks whether the connection to the bus exists."""


class Keys:
    """The subscriptions of one viewer.

    `start` runs a coroutine in the background. `holder` is the name under which subscriptions to
    other robots count against the shared limit.
    """

    def __init__(
        self,
        out: Outgoing,
        robots: Robots,
        start: Callable[[Coroutine[Any, Any, None]], None],
        holder: str,
    ) -> None:
        self._out, self._robots, self._start, self._holder = out, robots, start, holder

    def subscribe(self, frame: Subscribe) -> None:
        """Subscribe to a key or change its rate. The viewer receives the reason for a refusal."""
        robot, key = frame.robot or self._robots.id, frame.subscribe
        try:
            require_id(robot)
        except UsageError as error:
            self._out.refuse("subscribe", "malformed", str(error))
            return
        if key not in KEYS:
            text = f"{key!r} is not one of {', '.join(sorted(KEYS))}"
            self._out.refuse("subscribe", "malformed", text)
            return
        known = self._out.following.get((robot, key))
        others = sum(1.0 / one.period for one in self._out.following.values() if one is not known)
        if others + frame.rate > FRAMES_HZ:
            self._out.refuse(
                "subscribe",
                "too_many",
                f"at most {FRAMES_HZ:g} messages a second in all: lower the rates",
            )
        elif known is not None:
            known.period, known.due = 1.0 / frame.rate, 0.0
            self._out.wake()
        elif len(self._out.following) >= MOST:
            self._out.refuse("subscribe", "too_many", f"at most {MOST} keys: unsubscribe some")
        elif robot != self._robots.id and not self._shares.enter(self._holder, (robot, key)):
            text = (
                f"one token may follow {STREAMS_OF_ONE} keys of other robots at once, "
                f"and all tokens together {STREAMS}"
            )
            self._out.refuse("subscribe", "too_many", f"{text}: unsubscribe some")
        else:
            one = Following(robot, key, self._robots.id, 1.0 / frame.rate)
            self._out.following[robot, key] = one
            self._start(self._join(one))

    def unsubscribe(self, frame: Unsubscribe) -> None:
        """End the subscription to a key, if there is one."""
        name = frame.robot or self._robots.id, frame.unsubscribe
        # Remove it now, because the client may subscribe again in the next message.
        one = self._out.following.pop(name, None)
        if one is not None:
            self._give_back(one)
            if one.stream is not None:
                self._start(self._robots.streams.leave(*name))

    async def leave_all(self) -> None:
        """End all subscriptions."""
        followed, self._out.following = self._out.following, {}
        for one in followed.values():
            self._give_back(one)
        for one in followed.values():
            if one.stream is not None:
                await self._robots.streams.leave(one.robot, one.name)

    @property
    def _shares(self) -> Shares:
        return self._robots.streams.shares

    def _give_back(self, one: Following) -> None:
        if one.robot != self._robots.id:
            self._shares.leave(self._holder, (one.robot, one.name))

    async def _join(self, one: Following) -> None:
        stream = None
        while stream is None and self._is_followed(one):
            stream = await self._found(one)
        if stream is None:
            return
        if not self._is_followed(one):  # the viewer unsubscribed meanwhile
            await self._robots.streams.leave(one.robot, one.name)
            return
        one.stream = stream
        self._out.wake()

    async def _found(self, one: Following) -> Stream | None:
        """Return the stream of a key.

        Return None after a delay if the bus is not ready; the caller retries.
        """
        client = self._robots.client
        if client is None:
            await asyncio.sleep(CLIENT_S)
            return None
        try:
            return await self._robots.streams.follow(client, one.robot, one.name)
        except UNREADY:
            self._out.refuse("subscribe", "stuck", "the bus is stuck; the page tries again")
            await asyncio.sleep(AGAIN_S)
            return None

    def _is_followed(self, one: Following) -> bool:
        return self._out.following.get((one.robot, one.name)) is one
