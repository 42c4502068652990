"""Keeps the newest message of each subscribed key, as JSON for all viewers of the page.

The daemon sends msgpack. Zenoh's thread only stores each message. A message is converted to JSON
when the first viewer needs it, and only once for all viewers.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import zenoh

from acsard.bus.subscription import encoded, has_exact_key
from acsard.client.connection import Connection
from acsard.core.messages.encodings import DecodeError, to_json
from acsard.core.messages.keys_and_roles import FOLLOWED
from acsard.host import clock
from acsard.host.errors import NoAnswerError

Take = Callable[[zenoh.Sample], None]

VIEWER_KEYS = frozenset(topic.key for topic in FOLLOWED)


class Stream:
    """The newest message on one key of the robot."""

    def __init__(self) -> None:
        self._taking = threading.Lock()
        self._newest: tuple[int, zenoh.Sample | None, int] = (0, None, 0)
        self._text: tuple[int, bytes] = (0, b"null")
        self.users = 0
        self.subscription: Any = None  # of Zenoh
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

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._streams: dict[str, Stream] = {}

    def follow(self, key: str) -> Stream:
        """Return the stream of a key, for which the caller must call `leave` later."""
        with self._lock:
            stream = self._streams.setdefault(key, Stream())
            stream.users += 1
        return stream

    def leave(self, key: str) -> None:
        """Remove one user of a key; the subscription ends with the last one."""
        with self._lock:
            self._streams[key].users -= 1

    def update(self, client: Connection) -> None:
        """Begin the subscriptions of new users and end the unused ones. This may block."""
        with self._lock:
            unused = [key for key, stream in self._streams.items() if not stream.users]
            ended = [self._streams.pop(key).subscription for key in unused]
            new = [item for item in self._streams.items() if item[1].subscription is None]
        with suppress(zenoh.ZError, NoAnswerError):  # the session is closed
            for subscription in filter(None, ended):
                subscription.undeclare()
            for key, stream in new:
                _subscribe(client, key, stream)


def _subscribe(client: Connection, key: str, stream: Stream) -> None:
    def of_it(take: Take) -> Take:
        return lambda sample: take(sample) if has_exact_key(client.key(key), sample) else None

    stream.subscription = client.listen(key, of_it(stream.take))
    # The query gives a first value soon, even if the key is published rarely.
    client.start_query(key, of_it(stream.answered))


def as_json(encoding: str, payload: bytes) -> bytes:
    """Return a JSON or msgpack message as JSON, or as `null` if it cannot be decoded."""
    try:
        return to_json(encoding, payload)
    except DecodeError:
        return b"null"
