"""Keeps the newest message of each subscribed key, as JSON for all viewers of the page.

The daemon sends msgpack. Zenoh's thread only stores each message. A message is converted to JSON
when the first viewer needs it, and only once for all viewers.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgspec
import zenoh

from acsard.bus.subscription import encoded, has_exact_key
from acsard.client.connection import Connection
from acsard.core.messages.encodings import DecodeError, detect
from acsard.core.messages.keys_and_roles import FOLLOWED
from acsard.host import clock
from acsard.host.errors import UsageError
from acsard.host.threads import in_thread
from acsard.web.tasks import start

Take = Callable[[zenoh.Sample], None]

VIEWER_KEYS = frozenset(topic.key for topic in FOLLOWED)

DECLARE_TIMEOUT_S = 3.0

# The bus is stuck or the session is closed. A later attempt may succeed.
NOT_READY_ERRORS = (TimeoutError, zenoh.ZError, UsageError)


class Stream:
    """The newest message on one key of the robot."""

    def __init__(self) -> None:
        self._taking = threading.Lock()
        self._newest: tuple[int, zenoh.Sample | None, int] = (0, None, 0)
        self._text: tuple[int, bytes] = (0, b"null")
        self.declared: Any = None
        self.users = 0
        self.wakes: set[Callable[[], object]] = set()  # called for each message, in any thread
        self.lock = asyncio.Lock()

    @property
    def number(self) -> int:
        """Number of messages so far, and of the newest one."""
        return self._newest[0]

    @property
    def at_ns(self) -> int:
        """Arrival of the newest message on the clock `steady_ns`."""
        return self._newest[2]

    def take(self, sample: zenoh.Sample) -> None:
        with self._taking:
            self._newest = (self._newest[0] + 1, sample, clock.steady_ns())
        for wake in tuple(self.wakes):
            wake()

    def answered(self, sample: zenoh.Sample) -> None:
        """Store the answer to a query, unless a message has arrived, which may be newer."""
        with self._taking:
            if not self._newest[0]:
                self._newest = (1, sample, clock.steady_ns())

    def value(self) -> tuple[int, bytes, float]:
        """Return number, JSON text and age in ms of the newest message, 0 and null before it."""
        number, sample, at_ns = self._newest
        if sample is not None and self._text[0] != number:
            self._text = number, as_json(*encoded(sample))
        return number, self._text[1], max(0.0, (clock.steady_ns() - at_ns) / 1e6)

    def raw(self) -> tuple[str, bytes] | None:
        """Return the newest message as (encoding, payload)."""
        sample = self._newest[1]
        return None if sample is None else encoded(sample)


class Streams:
    """Subscriptions to keys of the robot, each shared by all its users."""

    def __init__(self) -> None:
        self._streams: dict[str, Stream] = {}
        self._ending: set[asyncio.Task[None]] = set()

    async def follow(self, client: Connection, key: str) -> Stream:
        """Return the stream of a key, for which the caller must call `leave` later.

        Raises one of `NOT_READY_ERRORS`.
        """
        stream = self._streams.get(key)
        if stream is None:
            stream = self._streams[key] = Stream()
        stream.users += 1
        try:
            async with stream.lock:
                if stream.declared is None:
                    stream.declared = await self._declare(client, key, stream)
        except BaseException:
            self.leave(key)
            raise
        return stream

    def followed(self, key: str) -> Stream | None:
        """Return the stream of a key that has a user."""
        return self._streams.get(key)

    def leave(self, key: str) -> None:
        """Remove one user of a key; after the last one, the subscription ends in the background."""
        stream = self._streams.get(key)
        if stream is None:
            return
        stream.users -= 1
        if stream.users:
            return
        del self._streams[key]
        if stream.declared is not None:
            start(attempt(stream.declared.undeclare), self._ending)

    async def _declare(self, client: Connection, key: str, stream: Stream) -> Any:
        def of_it(take: Take) -> Take:
            return lambda sample: take(sample) if has_exact_key(client.key(key), sample) else None

        def declare() -> Any:
            subscription = client.listen(key, of_it(stream.take))
            try:
                # The query gives a first value soon, even if the key is published rarely.
                client.start_query(key, of_it(stream.answered))
            except zenoh.ZError:
                subscription.undeclare()
                raise
            return subscription

        return await in_thread(declare, DECLARE_TIMEOUT_S, lambda late: late.undeclare())


async def attempt(call: Callable[[], object]) -> None:
    """Make a call that waits for the bus, in a thread, even if the bus is stuck or closed."""
    with suppress(*NOT_READY_ERRORS):
        await in_thread(call, DECLARE_TIMEOUT_S)


def as_json(encoding: str, payload: bytes) -> bytes:
    """Return a JSON or msgpack message as JSON, or as `null` if it cannot be decoded."""
    try:
        known = detect(encoding, payload) == "json"
        value = msgspec.json.decode(payload) if known else msgspec.msgpack.decode(payload)
        return payload if known else msgspec.json.encode(value)
    except (DecodeError, msgspec.MsgspecError, ValueError, RecursionError, TypeError):
        return b"null"
