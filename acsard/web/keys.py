"""The keys that one viewer follows: which, how often, and until when."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

from acsard.bus.address import require_id
from acsard.host.errors import UsageError
from acsard.web.frames import Subscribe, Unsubscribe
from acsard.web.limits import STREAMS, STREAMS_OF_ONE, Shares
from acsard.web.robots import AGAIN_S, Robots
from acsard.web.streams import KEYS, UNREADY, Stream
from acsard.web.to_browser import Following, Outgoing

MOST = 32

FRAMES_HZ = 300.0
"""Of all keys of one connection together: nobody who looks takes the time of who drives."""

CLIENT_S = 0.2
"""How often it is looked whether there is a way to the robot."""


class Keys:
    """Of one viewer; `start` runs what has to wait, `holder` is whose share of room it takes."""

    def __init__(
        self,
        out: Outgoing,
        robots: Robots,
        start: Callable[[Coroutine[Any, Any, None]], None],
        holder: str,
    ) -> None:
        self._out, self._robots, self._start, self._holder = out, robots, start, holder

    def subscribe(self, frame: Subscribe) -> None:
        """Follow a key, or another rate of it; what may not be is refused."""
        robot, key = frame.robot or self._robots.id, frame.subscribe
        try:
            require_id(robot)
        except UsageError as error:
            self._out.refuse("subscribe", "malformed", str(error))
            return
        if key not in KEYS:
            text = f"{key!r} is none of {', '.join(sorted(KEYS))}"
            self._out.refuse("subscribe", "malformed", text)
            return
        known = self._out.following.get((robot, key))
        others = sum(1.0 / one.period for one in self._out.following.values() if one is not known)
        if others + frame.rate > FRAMES_HZ:
            self._out.refuse("subscribe", "too_many", f"{FRAMES_HZ:g} messages a second in all")
        elif known is not None:
            known.period, known.due = 1.0 / frame.rate, 0.0
            self._out.wake()
        elif len(self._out.following) >= MOST:
            self._out.refuse("subscribe", "too_many", f"{MOST} keys at most")
        elif robot != self._robots.id and not self._shares.enter(self._holder, (robot, key)):
            text = f"{STREAMS_OF_ONE} keys of other robots for one token, {STREAMS} in all"
            self._out.refuse("subscribe", "too_many", f"no room: {text}; unsubscribe some")
        else:
            one = Following(robot, key, self._robots.id, 1.0 / frame.rate)
            self._out.following[robot, key] = one
            self._start(self._join(one))

    def unsubscribe(self, frame: Unsubscribe) -> None:
        """No more of it."""
        name = frame.robot or self._robots.id, frame.unsubscribe
        one = self._out.following.pop(name, None)  # at once: it may be subscribed to anew next
        if one is not None:
            self._give_back(one)
            if one.stream is not None:
                self._start(self._robots.streams.leave(*name))

    async def leave_all(self) -> None:
        """No more of any."""
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
        if not self._is_followed(one):  # left meanwhile
            await self._robots.streams.leave(one.robot, one.name)
            return
        one.stream = stream
        self._out.wake()

    async def _found(self, one: Following) -> Stream | None:
        """Its stream; None after a while where there is none yet, or once it is given up."""
        client = self._robots.client
        if client is None:
            await asyncio.sleep(CLIENT_S)
            return None
        try:
            return await self._robots.streams.follow(client, one.robot, one.name)
        except UNREADY:
            self._out.refuse("subscribe", "stuck", "the bus is stuck; it is tried again")
            await asyncio.sleep(AGAIN_S)
            return None

    def _is_followed(self, one: Following) -> bool:
        return self._out.following.get((one.robot, one.name)) is one
