"""The newest message of a key, as JSON, for as many viewers as there are.

Zenoh's thread only puts it down; it is made JSON when the first viewer is due, once for all. What
is subscribed to is the key as it is (msgpack): it costs the daemon one reader more, and no JSON.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import msgspec
import zenoh

from acsard.bus.subscription import encoded, on
from acsard.client import Client
from acsard.host import clock
from acsard.host.errors import UsageError
from acsard.host.threads import in_thread
from acsard.messages.encodings import DecodeError, detect
from acsard.messages.topics import PUBLISHED
from acsard.web.limits import STREAMS, STREAMS_OF_ONE, Shares

Take = Callable[[zenoh.Sample], None]

KEYS = frozenset(topic.key for topic in PUBLISHED) | {"imu"}
"""What may be followed."""

DECLARE_S = 3.0

STATE = "state"
"""Comes by itself, all the time. Asked for another robot's, a router's storage has the last one of
a robot that is off for a week."""

UNREADY = (TimeoutError, zenoh.ZError, UsageError)
"""A bus that is stuck, or a session that has ended: later there may be a way again."""


class Stream:
    """One key of one robot: nothing else may be handed to it."""

    def __init__(self) -> None:
        self._taking = threading.Lock()
        self._newest: tuple[int, zenoh.Sample | None, int] = (0, None, 0)
        self._text: tuple[int, bytes] = (0, b"null")
        self.declared: Any = None
        self.users = 0
        self.lock = asyncio.Lock()

    @property
    def number(self) -> int:
        """Of the newest; 0 before the first."""
        return self._newest[0]

    @property
    def at_ns(self) -> int:
        """When the newest came, by the monotonic clock."""
        return self._newest[2]

    def take(self, sample: zenoh.Sample) -> None:
        """One has come."""
        with self._taking:
            self._newest = (self._newest[0] + 1, sample, clock.mono_ns())

    def answered(self, sample: zenoh.Sample) -> None:
        """What was asked for: only what was published since then is newer."""
        with self._taking:
            if not self._newest[0]:
                self._newest = (1, sample, clock.mono_ns())

    def value(self) -> tuple[int, bytes, float]:
        """Number, JSON and age in ms of the newest."""
        number, sample, at_ns = self._newest
        if sample is not None and self._text[0] != number:
            self._text = number, as_json(*encoded(sample))
        return number, self._text[1], (clock.mono_ns() - at_ns) / 1e6

    def raw(self) -> tuple[str, bytes] | None:
        """Encoding and payload of the newest."""
        sample = self._newest[1]
        return None if sample is None else encoded(sample)


class Streams:
    """Those that somebody follows; the last to go ends one."""

    def __init__(self) -> None:
        self._streams: dict[tuple[str, str], Stream] = {}
        self.shares = Shares(STREAMS, STREAMS_OF_ONE)
        """Who follows what of other robots; to be entered before and left after."""

    async def follow(self, client: Client, robot: str, key: str) -> Stream:
        """The stream of this key; `TimeoutError` from a locked bus."""
        name = robot, key
        stream = self._streams.get(name)
        if stream is None:
            stream = self._streams[name] = Stream()
        stream.users += 1
        try:
            async with stream.lock:
                if stream.declared is None:
                    stream.declared = await self._declare(client, robot, key, stream)
        except BaseException:
            await self.leave(robot, key)
            raise
        return stream

    def followed(self, robot: str, key: str) -> Stream | None:
        """The stream that somebody follows, if anybody does."""
        return self._streams.get((robot, key))

    async def leave(self, robot: str, key: str) -> None:
        """One follows it no more."""
        stream = self._streams.get((robot, key))
        if stream is None:
            return
        stream.users -= 1
        if stream.users:
            return
        del self._streams[robot, key]
        if stream.declared is not None:
            try:
                await in_thread(stream.declared.undeclare, DECLARE_S)
            except (TimeoutError, zenoh.ZError):
                pass  # the bus is stuck, or gone: what comes goes nowhere

    async def _declare(self, own: Client, robot: str, key: str, stream: Stream) -> Any:
        client = own.like(robot)
        asks = key != STATE or own.key(key) == client.key(key)

        def late(subscriber: Any) -> None:
            subscriber.undeclare()

        def of_it(take: Take) -> Take:
            return lambda sample: take(sample) if on(client.key(key), sample) else None

        def declare() -> Any:
            heard = client.listen(key, of_it(stream.take))
            if not asks:
                return heard
            try:
                client.ask(key, of_it(stream.answered))  # what is published seldom is there at once
            except zenoh.ZError:
                heard.undeclare()
                raise
            return heard

        return await in_thread(declare, DECLARE_S, late)


def as_json(encoding: str, payload: bytes) -> bytes:
    """A message as JSON; null for what cannot be read."""
    try:
        known = detect(encoding, payload) == "json"
        told = msgspec.json.decode(payload) if known else msgspec.msgpack.decode(payload)
        return payload if known else msgspec.json.encode(told)
    except (DecodeError, msgspec.MsgspecError, ValueError, RecursionError, TypeError):
        return b"null"
