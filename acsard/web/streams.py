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

Take = Callable[[zenoh.Sample], None]

VIEWER_KEYS = frozenset(topic.key for topic in FOLLOWED)

DECLARE_TIMEOUT_S = 3.0

# After a failed attempt.
RETRY_DELAY_S = 1.0

# The bus is stuck or the session is closed. A later attempt may succeed.
NOT_READY_ERRORS = (TimeoutError, zenoh.ZError, UsageError)


class Stream:
    """The newest message on one key of the robot."""

    def __init__(self) -> None:
        self._taking = threading.Lock()
        self._newest: tuple[int, zenoh.Sample | None, int] = (0, None, 0)
        self._text: tuple[int, bytes] = (0, b"null")
        self.users, self.unused = 0, asyncio.Event()
        self.serving: asyncio.Task[None] | None = None
        self.wakes: set[Callable[[], object]] = set()  # called for each message, in any thread

    @property
    def number(self) -> int:
        """Number of messages so far, and of the newest one."""
        return self._newest[0]

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


class Streams:
    """Subscriptions to keys of the robot, each shared by all its users."""

    def __init__(self, client: Callable[[], Connection | None]) -> None:
        self._client = client  # None before the daemon is connected
        self._streams: dict[str, Stream] = {}

    def follow(self, key: str) -> Stream:
        """Return the stream of a key, for which the caller must call `leave` later.

        The subscription begins in the background, as soon as the bus is ready.
        """
        stream = self._streams.get(key)
        if stream is None:
            stream = self._streams[key] = Stream()
            stream.serving = asyncio.create_task(self._serve(key, stream))
        stream.users += 1
        return stream

    def leave(self, key: str) -> None:
        """Remove one user of a key; the subscription ends with the last one."""
        stream = self._streams[key]
        stream.users -= 1
        if not stream.users:
            del self._streams[key]
            stream.unused.set()

    async def _serve(self, key: str, stream: Stream) -> None:
        subscription = None
        while subscription is None and stream.users:
            client = self._client()
            try:
                if client is not None:
                    subscription = await _declare(client, key, stream)
            except NOT_READY_ERRORS:
                await asyncio.sleep(RETRY_DELAY_S)
            if client is None:
                await asyncio.sleep(0.2)
        await stream.unused.wait()
        if subscription is not None:
            with suppress(*NOT_READY_ERRORS):
                await in_thread(subscription.undeclare, DECLARE_TIMEOUT_S)


async def _declare(client: Connection, key: str, stream: Stream) -> Any:
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


def as_json(encoding: str, payload: bytes) -> bytes:
    """Return a JSON or msgpack message as JSON, or as `null` if it cannot be decoded."""
    try:
        known = detect(encoding, payload) == "json"
        value = msgspec.json.decode(payload) if known else msgspec.msgpack.decode(payload)
        return payload if known else msgspec.json.encode(value)
    except (DecodeError, msgspec.MsgspecError, ValueError, RecursionError, TypeError):
        return b"null"
